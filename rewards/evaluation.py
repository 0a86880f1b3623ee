"""Evaluation of rewards: checks of their outputs, and invalid scenes after failures."""

from __future__ import annotations

import hashlib
import linecache
import logging
import os
import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rewards.base import RewardContext, RewardOutput, declared_maximum, facts_of
from rewards.registry import as_output, is_own, resolve_reward, reward_name
from scene_envs.errors import MissingDependencyError, RewardError
from scene_envs.protocols import SceneScorer
from scene_envs.registry import describe_error, error_text
from scene_envs.scene import SceneBatch

logger = logging.getLogger(__name__)

DRAW: ContextVar[int] = ContextVar("draw", default=0)
"""Number of the stream of random numbers from which rewards draw."""
_warned: set[tuple[int, str]] = set()
_MAX_WARNINGS = 256


@contextmanager
def seeded_generators(seed: int, batch: SceneBatch | None = None) -> Iterator[None]:
    """Context in which the generators of torch (CPU), NumPy and Python have a seed that depends on the scenes.

    The seed depends only on ``seed``, the scenes (None while the reward is made) and :data:`DRAW`, so the same
    scenes get the same numbers in every call and process, and after a run is resumed. Earlier states come back
    afterwards.
    """
    states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    scenes = b"" if batch is None else batch.tensor.detach().cpu().contiguous().numpy().tobytes()
    digest = hashlib.blake2b(scenes, digest_size=8)
    digest.update(f"{seed} {DRAW.get()}".encode())
    number = int.from_bytes(digest.digest(), "little")
    torch.default_generator.manual_seed(number >> 1)
    np.random.seed(number % 2**32)  # noqa: NPY002
    random.seed(number)
    try:
        yield
    finally:
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])


@contextmanager
def other_draw(number: int) -> Iterator[None]:
    """Context in which rewards draw from the stream ``number`` of random numbers; the default stream is 0."""
    token = DRAW.set(number)
    try:
        yield
    finally:
        DRAW.reset(token)


def evaluate_reward(
    reward: Any, batch: SceneBatch, context: RewardContext | None = None, *, strict: bool = False
) -> RewardOutput:
    """Score ``batch`` and check the output against the contract.

    Args:
        reward: a reward object, or a function of (batch, context); see :func:`rewards.resolve_reward` for names.
        batch: B scenes of N slots.
        context: context for the reward; an empty one by default.
        strict: whether to raise on failure. Otherwise, if a reward raises or breaks its contract, all scenes are
            invalid with value NaN, and the reason is in ``problem`` and in one warning per reward and reason.

    Returns:
        float32 values, credits and terms, and a bool ``valid`` (B,) that also excludes rows that are not finite.

    Raises:
        RewardError: the reward failed, and ``strict`` is set.
        MissingDependencyError: a reward of this package needs another one that is not installed.

    >>> evaluate_reward(lambda batch, context: batch.counts, SceneBatch.empty("dimsum_table", 2)).value
    tensor([1., 1.])
    """
    try:
        return _evaluate(reward, batch, RewardContext() if context is None else context)
    except RewardError as error:
        if strict:
            raise
        return _failed(reward, batch, str(error))


def reward_scorer(reward: Any) -> SceneScorer:
    """``reward``, as for :func:`rewards.resolve_reward`, as a function that environments call; named by the entry point
    ``scene_envs.resolvers``.

    >>> reward_scorer("object_count")(SceneBatch.empty("dimsum_table", 2)).value
    tensor([1., 1.])
    """
    resolved = resolve_reward(reward)

    def score(batch: SceneBatch, *, prompts: tuple[str, ...] | None = None, pool: Any = None) -> RewardOutput:
        return evaluate_reward(resolved, batch, RewardContext(prompts=prompts, pool=pool))

    score.maximum = partial(declared_maximum, resolved)  # type: ignore[attr-defined]
    vars(score).update(facts_of(resolved))
    return score


def _evaluate(reward: Any, batch: SceneBatch, context: RewardContext) -> RewardOutput:
    name = reward_name(reward)
    version = (
        None if batch.tensor.is_inference() else batch.tensor._version
    )  # tensors of inference mode count no changes
    own, process = is_own(reward), os.getpid()
    given = batch if own else SceneBatch(batch.tensor.clone(), batch.scene_type)  # foreign code gets a copy
    try:
        with torch.no_grad(), nullcontext() if own else seeded_generators(context.seed, batch):
            output = as_output(reward(given, context))
    except (RewardError, KeyboardInterrupt):
        raise
    except SystemExit as error:
        raise RewardError(
            f"reward {name!r} called sys.exit({error_text(error)}){_place(error.__traceback__)}; raise an error instead"
        ) from error
    except BaseException as error:
        if own and isinstance(error, MissingDependencyError):
            raise
        raise RewardError(f"reward {name!r} raised {describe_error(error)}{_place(error.__traceback__)}") from error
    finally:
        if os.getpid() != process:  # the reward forked this copy of the process, which must not continue the run
            os._exit(0)
    changed = version is not None and batch.tensor._version != version
    if changed or not (own or torch.equal(given.tensor, batch.tensor)):
        raise RewardError(f"reward {name!r} changed the scenes it was given; work on a clone of batch.tensor")
    return _checked(name, output, batch)


def _place(trace: TracebackType | None) -> str:
    """Innermost line of foreign code, such as ``" (my_rewards.py, line 12)"``; empty if there is none."""
    found = ""
    package = Path(__file__).parent
    while trace is not None:
        path, line = trace.tb_frame.f_code.co_filename, trace.tb_lineno
        if Path(path).parent != package and linecache.getline(path, line) and "site-packages" not in path:
            found = f" ({path}, line {line})"
        trace = trace.tb_next
    return found


def _checked(name: str, output: Any, batch: SceneBatch) -> RewardOutput:
    if not isinstance(output, RewardOutput):
        raise RewardError(
            f"reward {name!r} returned {type(output).__name__}; return a (B,) tensor or a rewards.RewardOutput"
        )
    rows, grid = batch.counts, batch.is_empty
    value, credit = _tensor(name, "value", output.value, rows), output.per_object
    terms, flags = _named(name, "terms", output.terms), _named(name, "object_flags", output.object_flags)
    valid = torch.isfinite(value)
    if output.valid is not None:
        valid = valid & _tensor(name, "valid", output.valid, rows, is_bool=True)
    return RewardOutput(
        value,
        None if credit is None else _tensor(name, "per_object", credit, grid),
        {key: _tensor(name, f"terms[{key!r}]", term, rows) for key, term in terms.items()},
        valid,
        {key: _tensor(name, f"object_flags[{key!r}]", flag, grid, is_bool=True) for key, flag in flags.items()},
        output.problem,
    )


def _tensor(name: str, field: str, tensor: Any, like: Tensor, *, is_bool: bool = False) -> Tensor:
    """``tensor`` as float32 or bool; raises RewardError if it is of another kind, or has not the shape and device of
    ``like``.
    """
    place, shape = f"reward {name!r}: {field}", tuple(like.shape)
    if not isinstance(tensor, Tensor):
        raise RewardError(f"{place} is a {type(tensor).__name__}, expected a torch.Tensor")
    if tuple(tensor.shape) != shape:
        meaning = "(B,) = one number per scene" if len(shape) == 1 else "(B, N) = one entry per slot"
        raise RewardError(f"{place} has shape {tuple(tensor.shape)}, expected {shape}, {meaning}")
    if tensor.layout != torch.strided:
        raise RewardError(f"{place} is {tensor.layout}; use .to_dense()")
    if tensor.device != like.device:
        raise RewardError(f"{place} is on {tensor.device}, the scenes are on {like.device}")
    if is_bool and tensor.dtype != torch.bool:
        raise RewardError(f"{place} has dtype {tensor.dtype}, expected torch.bool")
    if not is_bool and not tensor.is_floating_point():
        raise RewardError(f"{place} has dtype {tensor.dtype}, expected a float; use .float()")
    return tensor if is_bool else tensor.detach().to(torch.float32)


def _named(name: str, field: str, tensors: Any) -> Mapping[str, Any]:
    if not isinstance(tensors, Mapping) or not all(isinstance(key, str) for key in tensors):
        raise RewardError(f"reward {name!r}: {field} must map names to tensors, got {type(tensors).__name__}")
    return tensors


def _failed(reward: Any, batch: SceneBatch, problem: str) -> RewardOutput:
    key = (id(reward), problem)
    if key not in _warned:
        if len(_warned) >= _MAX_WARNINGS:
            _warned.clear()
        _warned.add(key)
        logger.warning("%s. All %d scenes of this batch count as invalid.", problem.rstrip("."), len(batch))
    nothing = torch.full((len(batch),), torch.nan, device=batch.tensor.device)
    return RewardOutput(nothing, valid=torch.zeros_like(nothing, dtype=torch.bool), problem=problem)
