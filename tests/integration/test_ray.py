"""Generation on Ray: the same dataset as with one process."""

from __future__ import annotations

from pathlib import Path

import pytest

from scene_envs.datasets import generate
from tests.helpers import toy_grammars


@pytest.mark.slow
def test_ray_writes_the_same_files(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray")
    assert not ray.is_initialized()
    assert toy_grammars.TYPE.name == "toy_cups"  # whose grammar the workers import by its module
    options = {"seed": 3, "shard_size": 10, "progress": False}
    generate("toy_cups", 25, tmp_path / "here", workers=0, **options)
    # One CPU is enough: each worker takes seconds to start.
    report = generate("toy_cups", 25, tmp_path / "ray", workers=1, backend="ray", **options)
    assert report.scenes == 25
    here, there = ({file.name: file.read_bytes() for file in (tmp_path / name).iterdir()} for name in ("here", "ray"))
    assert here == there
    assert not ray.is_initialized()
