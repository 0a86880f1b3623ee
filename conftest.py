"""Isolation of tests: what one test or doctest registers, draws or warns of is unknown to the next."""

import gc
import os
import shutil
import tempfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest

for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # parallel tests do not fight for cores
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("RAY_worker_niceness", "0")  # at 15, Ray's default, its workers wait for the other tests
_TESTS, _MEMORY = Path(__file__).parent / "tests", "/dev/shm"
if "TMPDIR" not in os.environ and os.path.isdir(_MEMORY) and shutil.disk_usage(_MEMORY).free > 4 * 2**30:
    os.environ["TMPDIR"], tempfile.tempdir = _MEMORY, None  # files of tests wait for no disk
if "PYTEST_XDIST_WORKER" not in os.environ:  # its workers have the same folder
    os.environ["SCENE_ENVS_CACHE"] = (_CACHE := tempfile.TemporaryDirectory(prefix="scene_envs_cache")).name
if "SCENE_ENVS_TEST_DEVICE" not in os.environ:
    os.environ["CUDA_VISIBLE_DEVICES"] = ""  # numbers of tests are those of a CPU; `make test-gpu` compares
gc.disable()  # what collection imports is kept: the search of it for garbage costs seconds
os.register_at_fork(after_in_child=gc.freeze)  # a copy has no threads, for which a freed stage of USD waits forever


def _registries() -> list[dict[str, Any]]:
    """Every registry that users add to by name, the built-in entries in place."""
    from agents.networks.registry import _ENTRIES
    from agents.planning.ledger import _PLANNERS
    from agents.post_training.settings import _ALGORITHMS
    from rewards.registry import _REWARDS
    from scene_envs.envs.masks import _MASKS
    from scene_envs.export.formats import _FORMATS
    from scene_envs.grammars.grammar import GRAMMARS
    from scene_envs.scene_types import _SCENE_TYPES

    _load_shipped()
    return [_SCENE_TYPES, GRAMMARS, _MASKS, _FORMATS, _REWARDS, _ENTRIES, _PLANNERS, _ALGORITHMS]


@cache
def _load_shipped() -> None:
    """Import what modules of this project register; a module that is imported already would not register it again.

    Once per process: names of installed packages are read from all their metadata, which takes 0.1 s.
    """
    from agents.planning.ledger import _PLANNERS
    from scene_envs.grammars.grammar import GRAMMARS

    for registry in (GRAMMARS, _PLANNERS):
        for name in registry.names():
            registry[name]


@contextmanager
def _restored() -> Iterator[None]:
    from rewards.registry import _allowed_targets

    registries, targets = _registries(), list(_allowed_targets)
    before = [dict(registry) for registry in registries]
    yield
    _allowed_targets[:] = targets
    for registry, entries in zip(registries, before, strict=True):
        registry.clear()
        registry.update(entries)


@pytest.fixture(autouse=True, scope="module")
def _registries_of_module() -> Iterator[None]:
    """What the fixtures of a module register is forgotten with the module."""
    with _restored():
        yield


@pytest.fixture(autouse=True)
def _registries_of_test(_registries_of_module: None) -> Iterator[None]:
    """What a test registers is forgotten with the test; warnings that come once come once per test."""
    from rewards import evaluation

    evaluation._warned.clear()
    with _restored():
        yield


@pytest.fixture(autouse=True, scope="session")
def _copied_workers() -> Iterator[None]:
    """Workers start as copies of this process, but in tests that use ``new_interpreters``: these import for seconds."""
    if "SCENE_ENVS_TEST_DEVICE" in os.environ:  # no copy of a process that uses a GPU can use it
        yield
        return
    from tests.helpers.forked import forked_workers

    with forked_workers():
        yield


@pytest.hookimpl(wrapper=True)
def pytest_collect_file(file_path: Path) -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
    """Modules of tests have no doctests; to look for some in all that they import takes a second."""
    found = yield
    if file_path.is_relative_to(_TESTS) and ">>>" not in file_path.read_text(encoding="utf-8", errors="replace"):
        return [collector for collector in found if type(collector) is pytest.Module]
    return found


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    gc.freeze()  # no later search visits it either
    gc.set_threshold(20_000, 10, 10)  # searches after every 700 objects are a sixth of the tests' time
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_fixture_setup() -> None:
    _seed_torch()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call() -> None:
    _seed_torch()


def _seed_torch() -> None:
    """Seed torch's default generator as pytest-randomly seeds those of ``random`` and numpy.

    ``torch.manual_seed`` keeps a stack trace per call and kind of device until that device starts: milliseconds each.
    """
    import torch

    torch.default_generator.manual_seed(0)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(0)
