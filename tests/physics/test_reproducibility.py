"""Same result every time: whatever was simulated before, in whichever process, with however many workers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from benchmarks.reproducibility import FUNCTIONS, crowded, same, settled
from scene_envs.grammars import get_grammar
from scene_envs.physics import PhysicsPool, feasibility, settle
from scene_envs.scene import SceneBatch
from scene_envs.scene_types.built_in import BUILT_IN

pytestmark = pytest.mark.slow
NOISE = (0.004, 0.03)
"""A little and a lot (m); the benchmark takes more of them, and so more scenes, and each of them three times."""
FULLEST = {"restaurant_low_clutter": NOISE[:1], "restaurant_high_clutter": NOISE[:1]}
"""Types of many objects, one scene each: what is crowded without noise."""
NAMES = [scene_type.name for scene_type in BUILT_IN]


@pytest.fixture(scope="module")
def pool() -> Iterator[PhysicsPool]:
    with PhysicsPool(workers=2) as pool:
        yield pool


@pytest.mark.usefixtures("copied_workers")
@pytest.mark.parametrize("name", NAMES)
def test_no_history_changes_a_result(name: str, pool: PhysicsPool) -> None:
    """Each function in workers with histories of their own, and here in a random order, by batch or scene by scene."""
    batch, rng = crowded(name, FULLEST.get(name, NOISE)), np.random.default_rng(NAMES.index(name))
    expected = {key: function(batch, pool) for key, function in FUNCTIONS.items()}
    alone, whole = [slice(row, row + 1) for row in range(len(batch))], [slice(None)]
    calls = [(key, rows) for key in FUNCTIONS for rows in (alone if rng.random() < 0.5 else whole)]
    for index in rng.permutation(len(calls)):
        key, rows = calls[index]
        assert same(FUNCTIONS[key](batch[rows]), [values[rows] for values in expected[key]]), (key, rows)


def test_a_fresh_process_gives_the_same() -> None:
    """A worker's new interpreter that has simulated nothing else, and this one, which has."""
    batch = crowded("dimsum_table", (0.004,), seed=9)
    settled(crowded("dimsum_table", (0.004,), seed=10))
    with PhysicsPool(workers=1) as fresh:
        assert torch.equal(settled(batch, fresh)[0], settled(batch)[0])


def test_the_order_of_slots_changes_no_verdict() -> None:
    batch = crowded("dimsum_table", seed=11)
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    shuffled = SceneBatch(batch.tensor[:, order], batch.scene_type)
    assert torch.equal(feasibility(shuffled).feasible, feasibility(batch).feasible[:, order])


@pytest.mark.usefixtures("copied_workers")
def test_a_spent_budget_ends_at_the_same_step(pool: PhysicsPool) -> None:
    """Coincident objects: the simulation is cut short, after another one, and in workers, at the same poses."""
    clean = get_grammar("dimsum_table").sample(np.random.default_rng(2), 2)
    batch = SceneBatch(torch.cat([clean.tensor, clean.tensor[:, 1:]], dim=1), clean.scene_type)
    first = settle(batch)
    assert not bool(first.finished.any())
    settled(crowded("dimsum_table", (0.004,), seed=10))
    for again in (settle(batch), settle(batch, pool=pool)):
        assert same([first.batch.tensor, first.finished], [again.batch.tensor, again.finished])
