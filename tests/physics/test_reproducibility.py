"""Same result every time: whatever was simulated before, in whichever process, with however many workers."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from benchmarks.reproducibility import FUNCTIONS, crowded, same, settled
from scene_envs.grammars import get_grammar
from scene_envs.physics import PhysicsPool, feasibility, settle
from scene_envs.physics.motion import physics_of
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import BUILT_IN

pytestmark = pytest.mark.slow
TYPE = "dimsum_table"
"""The type of which every function is asked with two scenes; the benchmark asks that of all types, and more noise."""
NOISE = (0.004, 0.03)
"""A little and a lot (m)."""
COMPOSED = ("feasibility", "make_ready")
"""What the other types are asked of a scene each: `make_ready` projects and settles."""
SLOTS = 10
"""How many slots of the scenes of other types are filled."""
NAMES = list({scene_type.assets: scene_type.name for scene_type in BUILT_IN}.values())
"""One type for each set of assets."""


@pytest.fixture(scope="module")
def pool() -> Iterator[PhysicsPool]:
    with PhysicsPool(workers=2) as pool:
        yield pool


@pytest.mark.parametrize("name", NAMES)
def test_no_history_changes_a_result(name: str, pool: PhysicsPool) -> None:
    """Each function in workers with histories of their own, and here in a random order, by batch or scene by scene."""
    noise, functions = (NOISE, tuple(FUNCTIONS)) if name == TYPE else (NOISE[:1], COMPOSED)
    batch, rng = crowded(name, noise), np.random.default_rng(NAMES.index(name))
    if name != TYPE:
        batch = SceneBatch(batch.tensor[:, :SLOTS], batch.scene_type)
    expected = {key: FUNCTIONS[key](batch, pool) for key in functions}
    alone, whole = [slice(row, row + 1) for row in range(len(batch))], [slice(None)]
    calls = [(key, rows) for key in functions for rows in (alone if rng.random() < 0.5 else whole)]
    for index in rng.permutation(len(calls)):
        key, rows = calls[index]
        assert same(FUNCTIONS[key](batch[rows]), [values[rows] for values in expected[key]]), (key, rows)


@pytest.mark.usefixtures("new_interpreters")
def test_a_fresh_process_gives_the_same() -> None:
    """A worker's new interpreter that has simulated nothing else, and this one, which has."""
    batch = crowded(TYPE, NOISE[:1], seed=9)
    settled(crowded(TYPE, NOISE[:1], seed=10))
    with PhysicsPool(workers=1) as fresh:
        assert torch.equal(settled(batch, fresh)[0], settled(batch)[0])


def test_the_order_of_slots_changes_no_verdict() -> None:
    batch = crowded(TYPE, seed=11)
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    shuffled = SceneBatch(batch.tensor[:, order], batch.scene_type)
    assert torch.equal(feasibility(shuffled).feasible, feasibility(batch).feasible[:, order])


def test_a_spent_budget_ends_at_the_same_step(pool: PhysicsPool) -> None:
    """Coincident objects: the simulation is cut short, after another one, and in workers, at the same poses."""
    clean = get_grammar(TYPE).sample(np.random.default_rng(2), 2)
    batch = SceneBatch(torch.cat([clean.tensor[:, :12], clean.tensor[:, 1:12]], dim=1), clean.scene_type)
    first = settle(batch)
    assert not bool(first.finished.any())
    settled(crowded(TYPE, NOISE[:1], seed=10))
    for again in (settle(batch), settle(batch, pool=pool)):
        assert same([first.batch.tensor, first.finished], [again.batch.tensor, again.finished])


def test_the_order_of_slots_changes_no_settled_scene() -> None:
    batch = crowded(TYPE, NOISE[:1], seed=11)
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(1))
    shuffled = SceneBatch(batch.tensor[:, order], batch.scene_type)
    assert torch.equal(settled(shuffled)[0], settled(batch)[0][:, order])


def test_an_interrupted_simulation_changes_no_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    batch, other = crowded(TYPE, NOISE[:1], seed=12), crowded(TYPE, NOISE[:1], seed=13)
    expected = feasibility(other)
    engine = physics_of(batch.scene_type, "bullet").engine
    still = engine._is_still  # type: ignore[attr-defined]

    def interrupted(*arguments: object) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(engine, "_is_still", interrupted)
    with pytest.raises(KeyboardInterrupt):
        settle(batch)
    monkeypatch.setattr(engine, "_is_still", still)
    found = feasibility(other)
    assert torch.equal(found.displacement, expected.displacement)
    assert torch.equal(found.feasible, expected.feasible)


def test_threads_take_turns() -> None:
    drawn = [crowded(TYPE, NOISE[:1], seed=seed) for seed in (14, 15)]
    batches = [SceneBatch(batch.tensor[:, :SLOTS], batch.scene_type) for batch in drawn]
    expected = [settled(batch)[0] for batch in batches]
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda batch: settled(batch)[0], batches))
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
