"""Search run: scenes found by a planner and best-of-N at equal NFE, with output files."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import torch

from agents.configuration.composition import config_text, plain_tree
from agents.planning.ledger import PlanResult
from agents.planning.output import (
    SearchRecord,
    draw_curve,
    draw_scene,
    figures_of,
    loss_of,
    plan_figures,
    shown_nodes,
    write_tree_page,
)
from agents.planning.session import Journal, Session
from agents.planning.settings import SearchConfig
from agents.planning.simple import BestOfPlanner
from scene_envs.envs import SearchEnv, SearchMaskEnv, SearchState
from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import InvalidInputError, SceneEnvsError
from scene_envs.files import claimed, sealed, write_json, write_text
from scene_envs.scene import SceneBatch

_PLAIN = (bool, int, float, str, list, dict, type(None))
"""Types of values that YAML holds."""

_LIMITS = ("budget", "max_nfe", "max_seconds", "baseline", "workers")
"""Keys that do not affect the states of a search: they may change when a run is resumed."""

_OF_ENV = (
    "max_depth", "num_steps", "objective_scale", "workers", "physics", "prompt", "guidance", "claim_guidance",
    "physics_guidance",
)  # fmt: skip
"""Settings of a search that are arguments of its environment."""

Progress = Callable[[str, int, int, float], None]
"""Called after every round with the planner's name, the expansions so far, the budget and the best objective so far (at
most ``objective_scale``)."""


@dataclass(frozen=True)
class SearchOutcome:
    """Result of a search run.

    Attributes:
        search: the plan of the best search.
        searches: the plans of all ``count`` searches that found a scene. The best is first; if the searches started
            from scenes, the plans are in the order of these scenes.
        best_of: best of as many independent samples, the baseline at equal NFE; None without one.
        first: the best of the first ``branching`` samples of the best search, or the scene it started from; a batch of
            one.
        best: the best scene of each of ``searches``.
        metrics: contents of ``metrics.json``.
    """

    search: PlanResult
    searches: list[PlanResult]
    best_of: PlanResult | None
    first: SceneBatch
    best: SceneBatch
    metrics: dict[str, Any]


def run_search(
    prior: Any,
    objective: Any = "feasible_objects",
    *,
    config: SearchConfig | None = None,
    scenes: SceneBatch | None = None,
    output: str | Path | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> SearchOutcome:
    """Search for scenes that score high, starting from samples of the prior or from given scenes.

    The root is the scene with only fixed welded objects, so its children are fresh samples. The planner then
    regenerates the objects that the objective blames (Pfaff et al. 2025, inference-time search). With ``scenes`` there
    is one search for each scene, up to ``count``. It regenerates the blamed objects of that scene, and its result
    scores no less than the scene. The same seed and settings give the same scenes. An interrupt (Ctrl-C, SIGTERM) or
    ``max_seconds`` ends the search with the best scene so far. With an output folder, the same call resumes a search
    that was killed or has ended; the budget may then be larger. If there are more than ``side_by_side`` searches, the
    folder always has the scenes of the finished ones.

    Args:
        prior: a prior, or the name or path of one.
        objective: a reward, given as a name, mapping, function or object.
        config: settings of the search; None makes them from the keywords.
        scenes: scenes of the prior's type from which the searches start; None for fresh samples.
        output: folder for ``curve.png``, ``before.png``, ``after.png``, ``best.safetensors``, ``metrics.json``,
            ``tree.json``, ``tree.html``, the journals, and ``config.yaml``, in which functions and objects are left
            out; None writes nothing.
        progress: function to call after every round.
        **settings: fields of :class:`SearchConfig`.

    Raises:
        SceneEnvsError: no scene could be scored.
        InvalidInputError: another process writes into the folder, or it holds a search with other settings; the scenes
            are not of the prior's type, or have more slots than ``slots``.
    """
    if config is not None and settings:
        raise InvalidInputError(f"give config= or single settings, not both (got {', '.join(sorted(settings))})")
    config = SearchConfig(**settings) if config is None else config
    if scenes is not None and len(scenes) == 0:
        raise InvalidInputError("scenes holds no scene to start from")
    if scenes is not None:
        scenes = scenes.to("cpu")[: config.count]
    config = replace(config, count=(config.count or 1) if scenes is None else len(scenes))
    named = {"prior": prior, "objective": objective, **plain_tree(config)}
    with nullcontext() if output is None else claimed(output, "run_search") as folder:
        return _Run(prior, objective, config, named, scenes, folder, progress).search()


@dataclass
class _Run:
    """A search run, in a folder that no other process writes into; see :func:`run_search`."""

    prior: Any
    objective: Any
    config: SearchConfig
    named: dict[str, Any]  # settings, by the names of the arguments of run_search
    starts: SceneBatch | None
    folder: Path | None
    progress: Progress | None
    searches: list[PlanResult] = field(default_factory=list)  # so far, as in the outcome
    firsts: dict[int, SearchState] = field(default_factory=dict)  # by seed of a search: best first sample, or the start
    spent: int = 0  # scenes generated
    stopped: str = ""  # why the run ended early

    def __post_init__(self) -> None:
        self.prior, starts = resolve_prior(self.prior, self.config.device), self.starts
        if self.config.precision != "float32":
            self.prior = self.prior.with_precision(self.config.precision)
        self.fixed = {key: value for key, value in self.named.items() if key not in _LIMITS} | {"prior": self.prior}
        if starts is None:
            return
        scene_type = self.prior.scene_type
        if starts.scene_type.name != scene_type.name:
            raise InvalidInputError(
                f"the prior makes scenes of {scene_type.name!r}, and the search would start from scenes of "
                f"{starts.scene_type.name!r}; give a prior of that type"
            )
        self.fixed["scenes"], least = starts, max(scene_type.slots, starts.tensor.shape[1])
        self.starts = starts.with_slots(least if self.config.slots is None else self.config.slots)

    def search(self) -> SearchOutcome:
        """The outcome, which is also written to the folder."""
        config, starts, started = self.config, self.starts, time.perf_counter()
        planner, scenes = config.planner.make(config.branching), config.expansions
        actions = max(scenes, config.branching) if config.planner.widens else config.branching
        end = math.inf if config.max_seconds is None else started + config.max_seconds
        for part in config.parts:
            left = end - time.perf_counter()
            if left <= 0 and self.spent:
                self.stopped = "time"
                break
            name = "search" if len(config.parts) == 1 else f"search_{part.start:06}"
            env, session, plans = self.plan(planner, actions, scenes, part, name, max(left, 1e-9))
            self.spent, self.stopped = self.spent + sum(len(plan.values) for plan in plans), session.stopped
            self.searches += plans if starts is not None else [plan for plan in plans if plan.best_path]
            if starts is None:
                self.searches.sort(key=loss_of)
            for lane in session.lanes:
                if starts is not None or lane.first:
                    new = lane.first[: config.branching] if starts is None else [lane.root]
                    self.firsts[lane.root.seed] = max(new, key=lambda state: state.value if state.valid else -1.0)
            if self.folder is not None and len(config.parts) > 1 and self.searches:
                _scenes(env, self.searches).save(self.folder / "best.safetensors")
            if self.stopped:
                break
        searched, best_of = time.perf_counter(), None
        if config.baseline and self.spent and not self.stopped and searched < end:
            # Children are seeded by their path: the first scenes are those of the first search, unless that is steered.
            wide = self.spent if config.masks is None else max(actions, -(-self.spent // len(config.masks)))
            _, ended, (best_of,) = self.plan(BestOfPlanner(), wide, self.spent, range(1), "best of N", end - searched)
            best_of = None if ended.stopped else best_of  # of fewer scenes than the search, so no baseline of it
        seconds = {"search": searched - started, "best_of": time.perf_counter() - searched}
        self._check_found(session.lanes[0].root, env.problem.scale)
        best = min(self.searches, key=loss_of)
        outcome = SearchOutcome(
            search=best,
            searches=self.searches,
            best_of=best_of,
            first=env.scene(self.firsts[best.best_state.seed]),
            best=_scenes(env, self.searches),
            metrics=self._metrics(best_of, env.problem.scale, seconds),
        )
        if self.folder is not None:
            self._write(outcome, env, self.folder)
            if len(config.parts) == 1:
                _write_tree(outcome, env, session, self.folder)
        return outcome

    def _check_found(self, root: SearchState, scale: float) -> None:
        """Refuse a search whose empty ``root`` has the largest value, and one in which no scene could be scored."""
        if not self.searches and root.value >= 1:
            raise InvalidInputError(
                f"the objective {self.objective!r} is {root.objective:.4g} for the empty scene already, and the search "
                f"ends at objective_scale={scale:.4g}; give a larger objective_scale"
            )
        if not any(math.isfinite(plan.best_value) for plan in self.searches):
            samples = f"first {self.config.branching} samples of the prior"
            which = samples if self.starts is None else "scenes of the search"
            raise SceneEnvsError(
                f"the search was interrupted before its first {self.config.branching} scenes were made; call it again"
                if self.stopped and not self.spent
                else f"the objective {self.objective!r} could not score any of the {which}; the log above says why"
            )

    def _metrics(self, best_of: PlanResult | None, scale: float, seconds: dict[str, float]) -> dict[str, Any]:
        """Contents of ``metrics.json``."""
        named, starts, best = self.objective, self.starts, min(self.searches, key=loss_of)
        metrics: dict[str, Any] = {
            "objective": named if isinstance(named, str) else getattr(named, "__name__", repr(named)),
            "objective_scale": scale,
            "saturated": best.best_state.objective > scale,
            "below_zero": best.best_state.objective < 0,
            "planner": self.config.planner.name,
            "stopped": self.stopped or None,
            "nfe": self.spent * self.config.nfe_per_scene,
            "first_samples" if starts is None else "start": figures_of(self.firsts[best.best_state.seed]),
            "search": plan_figures(best),
            "seconds": {name: round(value, 2) for name, value in seconds.items()},
        }
        if len(self.searches) > 1:
            metrics["searches"] = [
                plan_figures(plan)
                | ({} if starts is None else {"start": figures_of(self.firsts[plan.best_state.seed])})
                for plan in self.searches
            ]
        return metrics if best_of is None else {**metrics, "best_of": plan_figures(best_of)}

    def _write(self, outcome: SearchOutcome, env: SearchEnv, folder: Path) -> None:
        config, metrics, best = self.config, outcome.metrics, outcome.search
        write_json(folder / "metrics.json", metrics, indent=2)
        outcome.best.save(folder / "best.safetensors")
        draw_curve(
            {
                config.planner.name: best.curve,
                **({} if outcome.best_of is None else {"best of N": outcome.best_of.curve}),
            },
            folder / "curve.png",
            num_steps=config.nfe_per_scene,
            first=config.branching if self.starts is None else 0,
            scale=metrics["objective_scale"],
            label=str(metrics["objective"]).replace("_", " "),
        )
        draw_scene(outcome.first, self.firsts[best.best_state.seed], folder / "before.png")
        draw_scene(env.scene(best.best_state), best.best_state, folder / "after.png")
        plain = {key: value for key, value in self.named.items() if isinstance(value, _PLAIN)}
        write_text(folder / "config.yaml", sealed(config_text(plain)))

    def plan(
        self, planner: Any, actions: int, budget: int, part: range, name: str, max_seconds: float = math.inf
    ) -> tuple[SearchEnv, Session, list[PlanResult]]:
        """The environment with ``actions`` actions per state, the session, and a plan of ``budget`` scenes per search
        of ``part``.
        """
        config = self.config
        if config.masks is None:
            kind, masks = SearchEnv, {"mask": config.mask}
        else:
            kind, masks = SearchMaskEnv, {"masks": config.masks}
        env = kind(
            scene=self.prior.scene_type,
            objective=self.objective,
            branching=actions,
            prior=self.prior,
            slots=config.slots if self.starts is None else self.starts.tensor.shape[1],
            **masks,
            **{key: getattr(config, key) for key in _OF_ENV},
        )
        journal = None
        if self.folder is not None:
            journal = Journal(self.folder / f"{name.replace(' ', '_')}.journal", self.fixed)
        session = Session(env, max_seconds=max_seconds, journal=journal)
        title, total = name.split("_")[0], budget * (config.count or 1 if name.startswith("search") else 1)
        before = part.start * budget
        report_to, scale = self.progress, env.problem.scale
        report = None if report_to is None else lambda done, best: report_to(title, before + done, total, best * scale)
        try:
            empty = SceneBatch.empty(self.prior.scene_type, 1, env.problem.slots)
            roots = []
            for search in part:
                root = empty if self.starts is None else self.starts[search : search + 1]
                env.reset(seed=config.seed + search, options={"scene": root})
                roots.append(env.clone_state())
            plans = session.run(planner, roots, budget, report, root_counts=self.starts is not None)
            return env, session, plans
        finally:
            env.close()


def _scenes(env: SearchEnv, plans: Sequence[PlanResult]) -> SceneBatch:
    return SceneBatch.concatenate([env.scene(plan.best_state) for plan in plans])


def _write_tree(outcome: SearchOutcome, env: SearchEnv, session: Session, output: Path) -> None:
    """Write ``tree.json`` and ``tree.html`` from the journal, which has the states of any planner."""
    assert session.journal is not None
    roots = [lane.root for lane in session.lanes]
    made = sum(len(lane.values) for lane in session.lanes)
    metrics = outcome.metrics
    settings = {name: metrics[name] for name in ("planner", "objective", "objective_scale")}
    settings["nfe_per_scene"] = env.problem.nfe_per_scene
    if "start" in metrics:
        settings["from_scene"] = True
    best = {plan.best_state.seed: tuple(plan.best_path) for plan in sorted(outcome.searches, key=loss_of)}
    record = SearchRecord.of(roots, islice(session.journal.states(), made), best, settings)
    record.save(output / "tree.json")
    shown = shown_nodes(record)
    made_states = chain(roots, session.journal.states())
    kept = {node: env.scene(state) for node, state in enumerate(made_states) if node in shown}
    last, best_scene = kept.get(record.searches[0]["best"]), env.scene(outcome.search.best_state)
    returned = None if last is not None and torch.equal(last.tensor, best_scene.tensor) else best_scene
    scenes = {node: kept[node] for node in shown}
    write_tree_page(output / "tree.html", record, scenes, metrics, returned=returned)
