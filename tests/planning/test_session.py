"""Sessions: limits, interrupts, resumption from a journal, searches in lock-step; with every planner."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.cli import main
from agents.planning import BestOfPlanner, GradientPlanner, PlanResult, Session, run_search
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards import RewardContext, RewardOutput, register_reward
from scene_envs.datasets import load_scenes
from scene_envs.errors import CorruptFileError, InvalidInputError, SceneEnvsError
from scene_envs.scene import SceneBatch
from tests.helpers.toy_tree import ToyTree, scrambled

SETTINGS: dict[str, Any] = {"budget": 15, "branching": 3, "num_steps": 2, "seed": 3, "baseline": False, "slots": 12}
PLANNERS = ("beam", "best_of", "evolution", "gradient", "greedy", "mcts")
ROUNDS_OF_THREE: dict[str, dict[str, Any]] = {
    "best_of": {"parallel": 3},
    "beam": {"width": 1},
    "evolution": {"population": 3, "crossover": 0.0},
}


def near_middle(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Half of the free objects within 20 cm of the middle, so that Φ stays below 1; the others are to blame."""
    central = batch.is_free & (batch.translations[..., :2].norm(dim=-1) < 0.2)
    return RewardOutput(0.5 * central.sum(-1).float(), object_flags={"feasible": central})


class Counting:
    """``near_middle`` that counts scenes and acts at the third call."""

    def __init__(self, act: Callable[[], None] = lambda: None) -> None:
        self.scored, self.calls, self.act = 0, 0, act

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        self.calls += 1
        if self.calls == 4:  # the root, two rounds, and then
            self.act()
        self.scored += len(batch)
        return near_middle(batch, context)


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.fixture(autouse=True)
def _without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("draw_curve", "draw_scene"):
        monkeypatch.setattr(f"agents.planning.search_run.{name}", lambda *_, **__: None)


@pytest.fixture(scope="module")
def prior() -> ScenePrior:
    return tiny_prior(slots=12)


@pytest.mark.slow
@pytest.mark.parametrize("planner", PLANNERS)
def test_a_killed_run_goes_on_bit_for_bit(planner: str, prior: ScenePrior, tmp_path: Path) -> None:
    settings = {**SETTINGS, "planner": {"name": planner}}
    all_scored = Counting()
    whole = run_search(prior, all_scored, output=tmp_path, **settings)
    journal = tmp_path / "search.journal"
    content = journal.read_bytes()
    shares = (0.999, 0.5, 0.0001, 0)  # a kill while writing the last record, in the middle, the first, none
    for share in shares if planner == "greedy" else shares[:2]:  # a journal without a record is of any planner
        journal.write_bytes(content[: int(share * len(content))])
        objective = Counting()
        again = run_search(prior, objective, output=tmp_path, **settings)
        assert again.search.values == whole.search.values
        assert again.search.best_path == whole.search.best_path
        assert torch.equal(again.best.tensor, whole.best.tensor)
        assert journal.read_bytes() == content
        assert objective.scored <= all_scored.scored if share > 0.4 else objective.scored == all_scored.scored


@pytest.mark.parametrize("planner", PLANNERS)
@pytest.mark.parametrize("count", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_an_interrupt_keeps_the_best_and_the_same_call_goes_on(
    planner: str, count: int, prior: ScenePrior, tmp_path: Path
) -> None:
    named = {"name": planner, **ROUNDS_OF_THREE.get(planner, {})}
    settings = {**SETTINGS, "planner": named, "count": count, "budget": 12}
    calls = Counting(interrupt) if count == 1 else Counting()
    if count > 1:  # every search has a root of its own, scored before the rounds
        calls.calls, calls.act = -(count - 1), interrupt
    stopped = run_search(prior, calls, output=tmp_path, **settings)
    assert stopped.metrics["stopped"] == "interrupt"
    assert stopped.metrics["nfe"] == 2 * 6 * count
    assert stopped.search.best_value == max(stopped.search.values)
    assert (tmp_path / "best.safetensors").exists()
    resumed = run_search(prior, Counting(), output=tmp_path, **settings)
    straight = run_search(prior, near_middle, **settings)
    assert resumed.search.values == straight.search.values
    assert torch.equal(resumed.best.tensor, straight.best.tensor)


def test_sigterm_keeps_the_best(prior: ScenePrior) -> None:
    before = signal.getsignal(signal.SIGTERM)
    outcome = run_search(prior, Counting(lambda: os.kill(os.getpid(), signal.SIGTERM)), **SETTINGS)
    assert outcome.metrics["stopped"] == "terminated"
    assert outcome.best_of is None
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("planner", PLANNERS)
def test_limits(planner: str, prior: ScenePrior) -> None:
    settings = {**SETTINGS, "planner": {"name": planner, **ROUNDS_OF_THREE.get(planner, {})}, "slots": None}
    by_nfe = run_search(prior, near_middle, **settings, max_nfe=2 * 7 + 1)
    assert len(by_nfe.search.values) <= 7
    by_time = run_search(prior, near_middle, **settings, max_seconds=1e-9)
    assert by_time.metrics["stopped"] == "time"
    assert by_time.search.values == by_nfe.search.values[:3]


class Slow(ToyTree):
    """A tree on whose clock a child takes a quarter of a second."""

    now = 0.0

    def expand_batch(self, pairs: Any, steering: Any = None) -> Any:
        self.now += 0.25 * len(pairs)
        return super().expand_batch(pairs)


@pytest.mark.parametrize("roots", [[()], [(7,), (8,)]])
def test_a_limit_of_time_ends_a_batch_of_any_size(roots: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    tree = Slow(scrambled, branching=64)
    monkeypatch.setattr("agents.planning.session.time.perf_counter", lambda: tree.now)
    session = Session(tree, max_seconds=10.125)
    results = session.run(BestOfPlanner(parallel=64), roots, budget=64)
    assert (session.stopped, tree.now) == ("time", 10.25)  # 40 scenes fit, and one goes beyond
    assert tree.batches == [16, 24, 1]
    made = results[0].values
    assert made == [scrambled((*roots[0], action)) for action in range(41)]
    assert results[0].best_value == max(made) == scrambled(results[0].best_state)
    assert [len(result.values) for result in results[1:]] == [0] * (len(roots) - 1)


def test_a_limit_of_time_keeps_the_children_of_a_parent_together_where_a_planner_steers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tree = Slow(scrambled, branching=64)
    monkeypatch.setattr("agents.planning.session.time.perf_counter", lambda: tree.now)
    session = Session(tree, max_seconds=6.0)
    session.run(GradientPlanner(planner={"name": "greedy", "children": 10}), [(7,), (8,), (9,)], budget=20)
    assert tree.batches == [20, 10]


@pytest.mark.slow
def test_searches_side_by_side_are_those_alone(prior: ScenePrior) -> None:
    sizes: list[int] = []

    def objective(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        sizes.append(len(batch))
        return near_middle(batch, context)

    settings = {**SETTINGS, "planner": "greedy"}
    together = run_search(prior, objective, count=3, **settings)
    assert len(together.best) == 3
    assert sizes[:4] == [1, 1, 1, 9]
    assert sizes.count(9) >= 3
    values = [plan.best_value for plan in together.searches]
    assert values == sorted(values, reverse=True)
    alone = [run_search(prior, near_middle, **{**settings, "seed": seed}).search for seed in (3, 4, 5)]
    assert sorted(plan.values for plan in alone) == sorted(plan.values for plan in together.searches)


@pytest.mark.slow
def test_many_searches_run_in_parts_whose_scenes_are_kept_after_a_kill(prior: ScenePrior, tmp_path: Path) -> None:
    settings = {**SETTINGS, "budget": 6, "count": 5, "side_by_side": 2, "planner": "greedy"}
    sizes: list[int] = []

    def objective(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        sizes.append(len(batch))
        return near_middle(batch, context)

    def dies(name: str, done: int, total: int, best: float) -> None:
        assert total == 5 * 6
        if done == 2 * 6 + 2 * 3:  # the first part, and a round of the second
            raise MemoryError

    with pytest.raises(MemoryError):
        run_search(prior, objective, output=tmp_path, progress=dies, **settings)
    assert max(sizes) == 2 * 3  # never more than two searches at once
    kept = load_scenes(tmp_path)
    assert len(kept) == 2
    sizes.clear()
    whole = run_search(prior, objective, output=tmp_path, **settings)
    assert sum(sizes) == 5 + 5 * 6 - (2 * 6 + 2 * 3)  # the roots, and what the first run had not made
    assert len(whole.searches) == len(load_scenes(tmp_path)) == 5
    assert whole.metrics["nfe"] == 5 * 6 * 2
    alone = [run_search(prior, near_middle, **{**settings, "count": 1, "seed": 3 + i}).search for i in range(5)]
    assert sorted(plan.values for plan in whole.searches) == sorted(plan.values for plan in alone)
    assert all(any(torch.equal(scene, other) for other in whole.best.tensor) for scene in kept.tensor)
    assert [plan.best_value for plan in whole.searches] == sorted((p.best_value for p in alone), reverse=True)


def test_side_by_side_as_alone_with_a_planner_that_scores_splices(prior: ScenePrior) -> None:
    settings = {**SETTINGS, "planner": {"name": "evolution", "population": 3, "crossover": 0.9}}
    together = run_search(prior, near_middle, count=2, **settings)
    alone = [run_search(prior, near_middle, **{**settings, "seed": seed}).search for seed in (3, 4)]
    assert sorted(plan.values for plan in alone) == sorted(plan.values for plan in together.searches)


def test_a_larger_budget_goes_on(prior: ScenePrior, tmp_path: Path) -> None:
    settings = {**SETTINGS, "planner": "greedy", "slots": None}
    small = run_search(prior, Counting(), output=tmp_path, **{**settings, "budget": 10})
    objective = Counting()
    large = run_search(prior, objective, output=tmp_path, **settings)
    assert large.search.values[:10] == small.search.values
    assert objective.scored == 1 + 5  # the root, and what is new


def test_another_search_in_the_folder_is_refused(prior: ScenePrior, tmp_path: Path) -> None:
    run_search(prior, near_middle, output=tmp_path, **SETTINGS)
    with pytest.raises(InvalidInputError, match="holds a search with seed=3, not 4; give another output"):
        run_search(prior, near_middle, output=tmp_path, **{**SETTINGS, "seed": 4})
    journal = tmp_path / "search.journal"
    content = bytearray(journal.read_bytes())
    content[len(content) // 2] ^= 1
    journal.write_bytes(content)
    with pytest.raises(CorruptFileError, match="is damaged at byte"):
        run_search(prior, near_middle, output=tmp_path, **SETTINGS)
    journal.write_text("a letter to a friend")
    with pytest.raises(CorruptFileError, match="is no journal"):
        run_search(prior, near_middle, output=tmp_path, **SETTINGS)
    assert journal.read_text() == "a letter to a friend"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget": 0}, "budget=0 scenes do not cover the 3 first samples"),
        ({"max_nfe": 5}, "max_nfe=5 does not cover the 3 first samples .* raise it to 6"),
        ({"max_seconds": 0}, "max_seconds=0 must be a positive number"),
        ({"count": 0}, "count=0 must be at least 1"),
        ({"side_by_side": 0}, "side_by_side=0 must be at least 1"),
        ({"num_steps": 0}, "num_steps=0 must be"),
        ({"slots": 1}, "slots=1: scenes of .* need at least 2 slots"),
        ({"planner": "beem"}, "did you mean 'beam'"),
        ({"planner": {"name": "beam", "width": 0}}, "planner beam: width=0 must be at least 1"),
        ({"planner": {"name": "mcts", "rollout": "some"}}, "unknown rollout 'some'"),
        ({"planner": {"name": "evolution", "crossover": 2}}, "planner evolution: crossover=2.0 is outside 0..1"),
        ({"planner": {"name": "gradient", "begin": 1}}, "planner gradient: begin=1.0 must lie in"),
        ({"mask": {"name": "empty", "cuont": 1}}, "did you mean 'count'"),
    ],
)
def test_bad_settings_name_themselves(settings: dict[str, Any], message: str, prior: ScenePrior) -> None:
    with pytest.raises(SceneEnvsError, match=message):
        run_search(prior, near_middle, **{**SETTINGS, **settings})


class Impatient:
    """A planner of another package: it expands the root for ever and leaves the end to the session."""

    def plan(self, problem: Any, budget: int, progress: Any = None) -> PlanResult:
        for action in range(10_000):
            problem.expand_batch([(problem.clone_state(), action)])
        raise AssertionError("the session lets no plan go beyond its budget")


class Failing:
    """A planner with an error of its own."""

    def plan(self, problem: Any, budget: int, progress: Any = None) -> PlanResult:
        problem.expand_batch([(problem.clone_state(), 0)])
        raise ZeroDivisionError("in the planner")


class Interrupted:
    """A planner that is interrupted between two rounds."""

    def plan(self, problem: Any, budget: int, progress: Any = None) -> PlanResult:
        problem.expand_batch([(problem.clone_state(), 0)])
        raise KeyboardInterrupt


def test_an_interrupt_between_rounds_keeps_the_best() -> None:
    session = Session(ToyTree(scrambled))
    (result,) = session.run(Interrupted(), [()], budget=20)
    assert session.stopped == "interrupt"
    assert (result.best_state, result.best_value) == ((0,), scrambled((0,)))


def test_a_planner_that_never_ends_is_ended_at_its_budget() -> None:
    results = Session(ToyTree(scrambled, branching=100)).run(Impatient(), [(), ()], budget=20)
    for result in results:
        assert result.values == [scrambled((action,)) for action in range(20)]
        assert result.best_value == max(result.values) == scrambled(result.best_state)


def test_an_error_of_one_plan_ends_all_and_is_raised() -> None:
    with pytest.raises(ZeroDivisionError, match="in the planner"):
        Session(ToyTree(scrambled)).run(Failing(), [(), ()], budget=20)
    broken = ToyTree(lambda path: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        Session(broken).run(Impatient(), [(), ()], budget=20)


@pytest.mark.slow
@pytest.mark.parametrize(("act", "status"), [(interrupt, 130), (lambda: os.kill(os.getpid(), signal.SIGTERM), 143)])
def test_an_interrupted_command_says_so_and_can_go_on(
    prior: ScenePrior, tmp_path: Path, capsys: pytest.CaptureFixture[str], act: Callable[[], None], status: int
) -> None:
    folder, output = prior.save(tmp_path / "prior"), tmp_path / "run"
    register_reward("interrupting")(Counting(act))
    words = ["search", f"prior={folder}", "objective=interrupting", "budget=9", "branching=3"]
    words += ["num_steps=2", "slots=12", "planner=greedy", f"output={output}"]
    assert main(words) == status
    shown = capsys.readouterr()
    assert "by greedy with 12 denoiser evaluations" in shown.out
    assert f"the same command with output={output} goes on where this one ended" in shown.err
    register_reward("interrupting")(Counting())
    assert main([*words, "max_seconds=1000", "count=1"]) == 0
    assert json.loads((output / "metrics.json").read_text())["nfe"] == 18
