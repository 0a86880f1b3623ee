"""Searches that start from given scenes: what they keep, what they give, and where the scenes may come from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from agents.cli import main
from agents.planning import (
    BeamPlanner,
    EvolutionPlanner,
    GreedyPlanner,
    MCTSPlanner,
    SearchRecord,
    run_search,
)
from agents.planning.session import _described
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards import RewardContext, RewardOutput
from rewards.counts import CategoryCount
from rewards.process import IsolatedReward
from rewards.registry import allow_local_rewards
from scene_envs.datasets import generate
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.toy_tree import ToyTree

SMALL = {"budget": 9, "branching": 3, "num_steps": 2, "planner": "greedy", "seed": 5}
WORDS = ["budget=6", "branching=3", "num_steps=2", "objective=object_count", "baseline=false"]


def near_middle(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Free objects within 20 cm of the middle; the others are to blame."""
    near = batch.is_free & (batch.translations[..., :2].norm(dim=-1) < 0.2)
    return RewardOutput(near.sum(-1).float(), object_flags={"feasible": near})


@pytest.fixture(scope="module")
def prior() -> ScenePrior:
    return tiny_prior()


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)


@pytest.mark.parametrize("planner", [GreedyPlanner, BeamPlanner, EvolutionPlanner, MCTSPlanner])
def test_a_root_that_counts_is_the_best_where_its_children_are_worse(planner: type) -> None:
    tree = ToyTree(lambda path: 0.9 if not path else 0.5 - 0.1 * len(path), branching=12)
    plan = planner(children=3).plan(tree, 12)
    assert (plan.best_path, plan.best_value) != ((), 0.9)
    tree.root_counts = True
    plan = planner(children=3).plan(tree, 12)
    assert (plan.best_path, plan.best_value, plan.start) == ((), 0.9, 0.9)
    assert len(plan.values) == 12
    assert set(plan.curve) == {0.9}


def test_greedy_repair_stays_at_the_given_scene_until_a_child_scores_as_much() -> None:
    tree = ToyTree(lambda path: 0.9 if not path else 0.5, branching=9, depth=1)
    tree.root_counts = True
    assert len(GreedyPlanner(children=3).plan(tree, 9).values) == 9


def test_every_scene_gets_a_search_that_scores_no_less(prior: ScenePrior, scenes: SceneBatch, tmp_path: Path) -> None:
    outcome = run_search(prior, near_middle, scenes=scenes, output=tmp_path, baseline=False, **SMALL)
    before, after = (near_middle(batch, RewardContext()).value for batch in (scenes, outcome.best))
    assert len(outcome.best) == 3
    assert bool((after >= before).all())
    found = outcome.metrics["searches"]
    assert [plan["start"]["objective"] for plan in found] == before.tolist()
    assert [plan["objective"] for plan in found] == after.tolist()
    assert outcome.metrics["search"]["objective"] == float(after.max())
    for start, plan in zip(scenes, outcome.searches, strict=True):
        if len(plan.best_path) == 1:  # what the scene does not blame stays, bit for bit
            kept = (near_middle(start, RewardContext()).object_flags["feasible"] | start.is_welded)[0]
            assert torch.equal(plan.best_state.scene[kept], start.tensor[0, kept])
    record = SearchRecord.load(tmp_path / "tree.json")
    roots = [record.nodes[search["root"]].objective for search in record.searches]
    assert sorted(roots) == sorted(before.tolist())
    page = (tmp_path / "tree.html").read_text()
    assert "from the start scene" in page
    assert "the empty scene" not in page


@pytest.mark.slow
def test_the_journal_knows_the_scenes_it_started_from(prior: ScenePrior, scenes: SceneBatch, tmp_path: Path) -> None:
    first = run_search(prior, near_middle, scenes=scenes, count=1, output=tmp_path, **SMALL)
    assert len(first.best) == 1
    again = run_search(prior, near_middle, scenes=scenes[:1], output=tmp_path, **SMALL)
    assert again.search.values == first.search.values
    assert first.best_of.values[:3] == first.search.values[:3]
    for others in (scenes[1:2], None):
        with pytest.raises(InvalidInputError, match="scenes=1 scenes"):
            run_search(prior, near_middle, scenes=others, output=tmp_path, **SMALL)


@pytest.mark.slow
def test_a_scene_that_is_perfect_or_cannot_be_scored_stays(
    prior: ScenePrior, scenes: SceneBatch, tmp_path: Path
) -> None:
    counts = scenes.is_free.sum(-1)
    top = int(counts.argmax())

    def until_top(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        free = batch.is_free.sum(-1)
        return RewardOutput(free.float(), valid=free == counts[top])

    settings = {**SMALL, "objective_scale": float(counts[top])}
    outcome = run_search(prior, until_top, scenes=scenes, output=tmp_path, **settings)
    assert torch.equal(outcome.best.tensor[top], scenes.tensor[top])
    assert outcome.searches[top].values == []
    one = run_search(prior, until_top, scenes=scenes[top], output=tmp_path / "one", **settings)
    assert (one.metrics["nfe"], one.metrics["start"]["value"], one.metrics["search"]["value"]) == (0, 1.0, 1.0)
    assert {"tree.html", "curve.png", "after.png"} <= {path.name for path in (tmp_path / "one").iterdir()}


@pytest.fixture(scope="module")
def sources(prior: ScenePrior, scenes: SceneBatch, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("sources")
    prior.save(folder / "prior")
    scenes.save(folder / "mine.safetensors")
    generate("dimsum_table", 3, folder / "dataset", seed=0, workers=0, verify=False, progress=False)
    words = ["sample", f"prior={folder / 'prior'}", "count=3", "num_steps=2", "reward=null", "pictures=0", "workers=0"]
    assert main([*words, f"output={folder / 'sampled'}"]) == 0
    return {
        "prior": folder / "prior",
        "file": folder / "mine.safetensors",
        "run": folder / "sampled",
        "dataset": folder / "dataset",
        "shard": next((folder / "dataset").glob("*.parquet")),
    }


@pytest.mark.slow
@pytest.mark.parametrize("source", ["file", "run", "dataset", "shard"])
def test_the_command_takes_what_scenes_takes(
    sources: dict[str, Path], source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["search", f"scenes={sources[source]}", f"prior={sources['prior']}", *WORDS, f"output={tmp_path}"]
    assert main([*words, "count=2"]) == 0
    assert len(SceneBatch.load(tmp_path / "best.safetensors")) == 2
    said = capsys.readouterr().out
    assert "best scenes of 2 searches" in said
    assert "they started from" in said
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert all(plan["objective"] >= plan["start"]["objective"] for plan in metrics["searches"])


def test_scenes_of_another_type_or_too_wide_are_refused(prior: ScenePrior, scenes: SceneBatch) -> None:
    other = get_grammar("pantry_shelf").sample(np.random.default_rng(0), 1)
    with pytest.raises(InvalidInputError, match=r"makes scenes of 'dimsum_table'.*scenes of 'pantry_shelf'"):
        run_search(prior, near_middle, scenes=other, **SMALL)
    with pytest.raises(InvalidInputError, match="slots=3: the scenes have an object in slot"):
        run_search(prior, near_middle, scenes=scenes, slots=3, **SMALL)
    with pytest.raises(InvalidInputError, match="no scene to start from"):
        run_search(prior, near_middle, scenes=scenes[:0], **SMALL)


def test_wider_scenes_keep_their_slots(prior: ScenePrior, scenes: SceneBatch) -> None:
    outcome = run_search(prior, "object_count", scenes=scenes[:1].with_slots(40), baseline=False, **SMALL)
    assert outcome.best.tensor.shape[1] == 40


@pytest.mark.slow
def test_a_search_is_not_continued_with_another_objective(prior: ScenePrior, tmp_path: Path) -> None:
    run_search(prior, CategoryCount("teacup"), output=tmp_path / "assets", **SMALL)
    with pytest.raises(InvalidInputError, match="holds a search with objective"):
        run_search(prior, CategoryCount("dinner_plate"), output=tmp_path / "assets", **SMALL)
    file = tmp_path / "mine.py"
    allow_local_rewards(file)
    file.write_text("def a(batch):\n    return batch.counts\n")
    with IsolatedReward(f"{file}:a") as reward:
        before = _described(reward)
        assert f"{file}:a" in before
        file.write_text(file.read_text() + "# changed\n")
        assert _described(reward) != before
