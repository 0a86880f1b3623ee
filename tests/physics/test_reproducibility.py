"""Same result every time: whatever was simulated before, in whichever process, with however many workers."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from scene_envs.grammars import get_grammar
from scene_envs.physics import PhysicsPool, feasibility, make_ready, project, settle
from scene_envs.scene import SceneBatch

pytestmark = pytest.mark.slow

NOISE = (0.004, 0.03)
"""m along every axis; one scene each."""


def crowded(name: str, seed: int = 5) -> SceneBatch:
    """Two scenes with as many objects as the fullest of six draws have, thrown about by 4 and 30 mm."""
    drawn = get_grammar(name).sample(np.random.default_rng(seed), 6)
    clean = drawn[drawn.counts.argsort(descending=True)[: len(NOISE)]]
    scale = torch.tensor(NOISE)[:, None, None]
    noise = scale * torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(seed))
    return clean.with_poses(clean.translations + noise * clean.is_free.unsqueeze(-1), clean.rotations)


def settled(batch: SceneBatch, pool: PhysicsPool | None = None) -> list[Tensor]:
    result = settle(batch, duration=0.25, pool=pool)
    return [result.batch.tensor, result.valid]


def projected(batch: SceneBatch, pool: PhysicsPool | None = None) -> list[Tensor]:
    result = project(batch, pool=pool)
    return [result.batch.tensor, result.residual_depth, result.converged]


def judged(batch: SceneBatch, pool: PhysicsPool | None = None) -> list[Tensor]:
    result = feasibility(batch, pool=pool)
    return [result.feasible, result.depth, result.displacement, result.rotation, result.valid]


def made_ready(batch: SceneBatch, pool: PhysicsPool | None = None) -> list[Tensor]:
    result = make_ready(batch, duration=0.25, rounds=1, pool=pool)
    return [result.batch.tensor, result.ready, result.valid]


Function = Callable[..., list[Tensor]]
FUNCTIONS: dict[str, Function] = {f.__name__: f for f in (settled, projected, judged, made_ready)}


def same(first: list[Tensor], second: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.fixture(scope="module")
def pool() -> Iterator[PhysicsPool]:
    with PhysicsPool(workers=2) as pool:
        yield pool


@pytest.mark.parametrize("name", ["dimsum_table", "pantry_shelf"])
def test_no_history_changes_a_result(name: str, pool: PhysicsPool) -> None:
    """Each function of each scene alone, after others in a random order, and in workers with histories of their own."""
    batch = crowded(name)
    expected = {key: function(batch) for key, function in FUNCTIONS.items()}
    calls = [(key, row) for key in FUNCTIONS for row in range(len(batch))]
    for index in np.random.default_rng(sum(map(ord, name))).permutation(len(calls)):
        key, row = calls[index]
        alone = FUNCTIONS[key](batch[row : row + 1])
        assert same(alone, [values[row : row + 1] for values in expected[key]]), (key, row)
    for key, function in FUNCTIONS.items():
        assert same(function(batch, pool), expected[key]), key


def test_a_fresh_process_gives_the_same(tmp_path: Path) -> None:
    """A new interpreter that has simulated nothing else, and this one, which has."""
    batch = crowded("dimsum_table", seed=9)[:1]
    batch.save(tmp_path / "scenes.safetensors")
    settled(crowded("dimsum_table", seed=10)[:1])
    script = (
        "import sys, torch\n"
        "from scene_envs.physics import settle\n"
        "from scene_envs.scene import SceneBatch\n"
        "folder = sys.argv[1]\n"
        "batch = SceneBatch.load(folder + '/scenes.safetensors')\n"
        "settle(batch, duration=0.25).batch.save(folder + '/settled.safetensors')\n"
    )
    subprocess.run([sys.executable, "-c", script, str(tmp_path)], check=True, timeout=300)
    assert torch.equal(SceneBatch.load(tmp_path / "settled.safetensors").tensor, settled(batch)[0])


def test_the_order_of_slots_changes_no_verdict() -> None:
    batch = crowded("dimsum_table", seed=11)
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    shuffled = SceneBatch(batch.tensor[:, order], batch.scene_type)
    assert torch.equal(feasibility(shuffled).feasible, feasibility(batch).feasible[:, order])


def test_a_spent_budget_ends_at_the_same_step(pool: PhysicsPool) -> None:
    """Coincident objects: the simulation is cut short, after another one, and in workers, at the same poses."""
    clean = get_grammar("dimsum_table").sample(np.random.default_rng(2), 2)
    batch = SceneBatch(torch.cat([clean.tensor, clean.tensor[:, 1:]], dim=1), clean.scene_type)
    first = settle(batch)
    assert not bool(first.finished.any())
    settled(crowded("dimsum_table", seed=10)[:1])
    for again in (settle(batch), settle(batch, pool=pool)):
        assert same([first.batch.tensor, first.finished], [again.batch.tensor, again.finished])
