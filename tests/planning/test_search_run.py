"""Search runs on an untrained prior: what is reproducible, kept and written, and searches from given scenes."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from agents.cli import main
from agents.planning import (
    BeamPlanner,
    EvolutionPlanner,
    GreedyPlanner,
    MCTSPlanner,
    SearchOutcome,
    SearchRecord,
    run_search,
)
from agents.planning.session import _described
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards import RewardContext, RewardOutput, register_reward
from rewards.counts import CategoryCount
from rewards.process import IsolatedReward
from rewards.registry import allow_local_rewards
from scene_envs.datasets import generate
from scene_envs.envs import SearchEnv
from scene_envs.errors import InvalidInputError, SceneEnvsError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.toy_tree import ToyTree

SETTINGS = {
    "budget": 24,
    "branching": 3,
    "num_steps": 4,
    "max_depth": 5,
    "seed": 3,
    "mask": "infeasible",
    "planner": "greedy",
}


def central_objects(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Free objects within 10 cm of the middle; the others are to blame."""
    central = batch.is_free & (batch.translations[..., :2].norm(dim=-1) < 0.1)
    return RewardOutput(central.sum(-1).float(), object_flags={"feasible": central})


@dataclass(frozen=True)
class Run:
    prior: ScenePrior
    outcome: SearchOutcome
    output: Path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    prior, output = tiny_prior(), tmp_path_factory.mktemp("search")
    return Run(prior, run_search(prior, central_objects, output=output, **SETTINGS), output)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the run above are looked at; those of others would take most of their time."""
    for name in ("draw_curve", "draw_scene"):
        monkeypatch.setattr(f"agents.planning.search_run.{name}", lambda *_, **__: None)


def fresh_root(env: SearchEnv, seed: int) -> SearchEnv:
    env.reset(seed=seed, options={"scene": SceneBatch.empty(env.problem.scene_type, 1)})
    return env


def test_search_beats_its_first_samples(run: Run) -> None:
    metrics = run.outcome.metrics
    assert metrics["search"]["objective"] > metrics["first_samples"]["objective"]
    assert metrics["search"]["objective"] == float(central_objects(run.outcome.best, RewardContext()).value)
    assert metrics["first_samples"]["objective"] == float(central_objects(run.outcome.first, RewardContext()).value)


def test_both_planners_spend_the_same_and_begin_with_the_same_samples(run: Run) -> None:
    search, best_of, metrics = run.outcome.search, run.outcome.best_of, run.outcome.metrics
    assert len(search.values) == len(best_of.values) == 24
    assert metrics["nfe"] == 24 * 4
    assert search.values[:3] == best_of.values[:3]
    assert max(search.values[:3]) == metrics["first_samples"]["value"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_tree_and_another_seed_another(run: Run) -> None:
    again = run_search(run.prior, central_objects, baseline=False, **SETTINGS)
    other = run_search(run.prior, central_objects, baseline=False, **{**SETTINGS, "seed": 4})
    assert again.search.values == run.outcome.search.values
    assert again.search.best_path == run.outcome.search.best_path
    assert torch.equal(again.best.tensor, run.outcome.best.tensor)
    assert not torch.equal(other.best.tensor, run.outcome.best.tensor)


def test_a_scene_depends_on_its_path_alone_and_keeps_what_is_not_masked(run: Run) -> None:
    settings = {key: SETTINGS[key] for key in ("num_steps", "max_depth", "mask")}
    env = fresh_root(SearchEnv(prior=run.prior, objective=central_objects, branching=24, **settings), 3)
    state, found = env.clone_state(), run.outcome.search
    assert len(found.best_path) > 1
    for action in found.best_path:
        parent, state = state, env.expand(state, action)
        kept = ~parent.mask
        assert torch.equal(state.scene[kept], parent.scene[kept])
    torch.testing.assert_close(state.scene, found.best_state.scene, atol=1e-4, rtol=0)  # in a batch of three


def test_files_hold_what_was_found(run: Run) -> None:
    names = {path.name for path in run.output.iterdir()}
    pictures, journals = {"curve.png", "before.png", "after.png"}, {"search.journal", "best_of_N.journal"}
    trees = {"tree.json", "tree.html"}
    assert names == {*pictures, *journals, *trees, "best.safetensors", "metrics.json", "config.yaml"}
    assert torch.equal(SceneBatch.load(run.output / "best.safetensors").tensor, run.outcome.best.tensor)
    metrics = json.loads((run.output / "metrics.json").read_text())
    assert metrics["search"]["curve"][-1] == metrics["search"]["value"] == run.outcome.search.best_value
    assert yaml.safe_load((run.output / "config.yaml").read_text())["budget"] == 24
    for name in ("curve.png", "before.png", "after.png"):
        assert (run.output / name).read_bytes().startswith(b"\x89PNG")


def test_progress_names_the_planner(run: Run) -> None:
    told: list[tuple[str, int, int]] = []
    run_search(
        run.prior,
        central_objects,
        progress=lambda name, done, budget, best: told.append((name, done, budget)),
        **SETTINGS,
    )
    assert [t for t in told if t[0] == "search"] == [("search", n, 24) for n in range(3, 25, 3)]
    assert told[-1] == ("best of N", 24, 24)


@pytest.mark.slow
def test_an_objective_that_never_scores_is_an_error(run: Run) -> None:
    def broken(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        raise RuntimeError("no such sensor")

    with pytest.raises(SceneEnvsError, match="could not score any of the first 3 samples"):
        run_search(run.prior, broken, **SETTINGS)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_an_objective_beyond_its_scale_is_reported_with_its_raw_value(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    @register_reward("far_beyond")
    def far_beyond(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        return RewardOutput(torch.where(batch.is_free.any(-1), 50.0 + batch.is_free.sum(-1), 0.0))

    output = tmp_path / "run"
    words = ["search", f"prior={run.prior.save(tmp_path / 'prior')}", "objective=far_beyond", "baseline=false"]
    words += ["budget=9", "branching=3", "num_steps=2"]
    assert main([*words, f"output={output}"]) == 0
    metrics = json.loads((output / "metrics.json").read_text())
    found = int(SceneBatch.load(output / "best.safetensors").is_free.sum())
    assert metrics["saturated"]
    assert (metrics["search"]["value"], metrics["search"]["objective"]) == (1.0, 50 + found)
    assert "that is beyond objective_scale=33" in capsys.readouterr().out
    assert main([*words, "objective_scale=100", f"output={tmp_path / 'more'}"]) == 0
    metrics = json.loads((tmp_path / "more" / "metrics.json").read_text())
    assert not metrics["saturated"]
    assert metrics["search"]["expansions"] == 9
    assert "that is beyond" not in capsys.readouterr().out


def test_an_objective_that_is_beyond_its_scale_without_objects_says_so(run: Run) -> None:
    def beyond(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        return RewardOutput(torch.full((len(batch),), 50.0))

    with pytest.raises(InvalidInputError, match=r"is 50 for the empty scene already, .* at objective_scale=33"):
        run_search(run.prior, beyond, **SETTINGS)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_an_objective_below_zero_is_said_with_a_shift_that_works(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["search", f"prior={run.prior.save(tmp_path / 'prior')}", "baseline=false", "budget=9", "branching=3"]
    words += ["num_steps=2"]
    assert main([*words, "objective=penetration", f"output={tmp_path / 'below'}"]) == 0
    metrics = json.loads((tmp_path / "below" / "metrics.json").read_text())
    assert metrics["below_zero"]
    assert set(metrics["search"]["curve"]) == {0.0}
    said = " ".join(capsys.readouterr().out.split())
    shifted = re.search(r"objective='(\{name: weighted_sum.*?\})' objective_scale=(\S+)", said)
    assert shifted is not None
    words += [f"objective={shifted[1]}", f"objective_scale={shifted[2]}"]
    assert main([*words, f"output={tmp_path / 'shifted'}"]) == 0
    metrics = json.loads((tmp_path / "shifted" / "metrics.json").read_text())
    assert not metrics["below_zero"]
    assert 0 < metrics["search"]["value"] < 1


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("planner", ["greedy", "mcts", "evolution"])
def test_an_action_may_choose_among_masks(run: Run, tmp_path: Path, planner: str) -> None:
    settings = {**SETTINGS, "budget": 12, "planner": planner, "masks": ["culprits", {"name": "empty", "count": 2}]}
    outcome = run_search(run.prior, central_objects, output=tmp_path, **settings)
    assert len(outcome.search.values) == 12
    assert outcome.best_of is not None
    assert outcome.best_of.values[: SETTINGS["branching"]] == outcome.search.values[: SETTINGS["branching"]]
    again = run_search(run.prior, central_objects, output=tmp_path, **settings)  # from the journal
    assert again.search.values == outcome.search.values
    with pytest.raises(InvalidInputError, match="at least one mask"):
        run_search(run.prior, central_objects, **{**SETTINGS, "masks": []})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget": 2, "branching": 3}, "budget=2 scenes do not cover the 3 first samples"),
        ({"branching": 0}, "branching=0"),
        ({"mask": "culprit"}, "did you mean 'culprits'"),
        ({"objective": "central_object"}, "unknown reward 'central_object'"),
    ],
)
def test_bad_settings_name_themselves(run: Run, settings: dict, message: str) -> None:
    with pytest.raises(SceneEnvsError, match=message):
        run_search(run.prior, **{"objective": central_objects, **SETTINGS, **settings})


def test_settings_come_from_one_place(run: Run) -> None:
    from agents.planning import SearchConfig

    with pytest.raises(InvalidInputError, match="not both"):
        run_search(run.prior, central_objects, config=SearchConfig(), budget=3)


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
