"""Planners that a user adds to ``scene-envs search``: UCT, a tree over the steps of the denoising, Feynman-Kac.

    scene-envs search planner=./examples/planners.py:uct prior=dimsum_table output=runs/uct

``python examples/planners.py planner=uct ...`` is the same command. All keys of ``search`` are accepted; those of the
planners are the attributes of the dataclasses. None of them is ahead in a table of benchmarks/search.md, so the package
has none of them. They show how a planner uses the :class:`~agents.planning.SearchBudget` of a plan, which spends the
budget and keeps the best state, and two ways in which a planner steers the denoising itself.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from agents.cli import main
from agents.planning import GreedyPlanner, PlannerSettings, PlanResult, Searchable, SearchBudget, register_planner
from agents.planning.ledger import Candidate, Progress, SteeredProblem
from scene_envs import SceneBatch
from scene_envs.errors import BELOW_ONE, Count, InvalidInputError, at_least


@dataclass(eq=False)
class Node:
    """A state in the tree of UCT; ``pending`` counts the expansions below it that are chosen and not yet evaluated."""

    candidate: Candidate
    actions: Sequence[int]
    parent: Node | None = None
    children: list[Node] = field(default_factory=list)
    tried: int = 0
    visits: int = 0
    pending: int = 0
    total: float = 0.0
    open_children: int = 0

    @property
    def is_open(self) -> bool:
        """Whether an action at this node, or below it, can be chosen."""
        return self.tried < len(self.actions) or self.open_children > 0

    def line(self) -> Iterator[Node]:
        """This node and all nodes above it."""
        node: Node | None = self
        while node is not None:
            yield node
            node = node.parent

    def closed(self) -> None:
        """Subtract this node, if it has closed, from the open children of its parent, and so on towards the root."""
        for node in self.line():
            if node.is_open or node.parent is None:
                return
            node.parent.open_children -= 1

    def add(self, child: Node) -> None:
        """Add a child that was evaluated."""
        self.children.append(child)
        if child.is_open:
            for node in self.line():
                was_open = node.is_open
                node.open_children += 1
                if was_open:
                    break
        for node in child.line():
            node.visits, node.total = node.visits + 1, node.total + child.candidate.value


@register_planner("uct")
@dataclass(frozen=True)
class UCTPlanner(PlannerSettings):
    """Upper confidence bounds applied to trees (Kocsis & Szepesvári 2006), for states that score themselves.

    Every state is a whole scene, so its objective is its value and there are no random rollouts. One iteration descends
    by mean + exploration * sqrt(ln(visits of the parent) / visits), expands one action, evaluates the child and backs
    its value up. The search does not continue below a child that holds the scene of another node.

    Attributes:
        exploration: weight of the bound. The textbook value sqrt(2) is for independent values over the whole of [0, 1];
            siblings of one scene differ by a few hundredths, so the default is smaller.
        parallel: number of expansions that are chosen before any is evaluated, as one batch of the denoiser; each
            counts as a visit of value 0 until then (virtual loss). null takes ``branching``.
        children: number of children of a state before the search goes below them; null takes ``branching``.
        widening: exponent of progressive widening (Coulom 2007): a state of n visits may have n^widening children; 0
            for no widening.
        max_loss: largest amount by which the value of a child may be below its parent's; the search does not continue
            below a worse child.
    """

    name: str = "uct"
    widens = True
    exploration: Annotated[float, at_least(0)] = 0.05
    parallel: Count | None = None
    children: Count | None = None
    widening: Annotated[float, at_least(0)] = 0.5
    max_loss: Annotated[float, at_least(0)] = 1.0

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions on the tree below the problem's current state."""
        ledger = SearchBudget(problem, budget, progress)
        root = Node(ledger.root, ledger.actions(ledger.root))
        seen = {ledger.root.fingerprint}
        while ledger.left:
            chosen: list[tuple[Node, int]] = []
            while root.is_open and len(chosen) < min(self.parallel or 1, ledger.left):
                chosen.append(self.choose(root))
            made = ledger.expand([(node.candidate, action) for node, action in chosen])
            if not made:
                break
            for (node, _), child in zip(chosen, made, strict=False):
                for above in node.line():
                    above.pending -= 1
                if child.valid:
                    worse = node.parent is not None and child.value < node.candidate.value - self.max_loss
                    again = worse or child.fingerprint in seen
                    seen.add(child.fingerprint)
                    node.add(Node(child, () if again else ledger.actions(child), node))
        return ledger.result()

    def choose(self, node: Node) -> tuple[Node, int]:
        """The next expansion: the node that the bounds lead to, and its next action, which is reserved."""
        while not self.takes_another_child(node):
            weight = self.exploration * math.sqrt(math.log(max(1, node.visits + node.pending)))
            node = max((child for child in node.children if child.is_open), key=partial(bound, weight))
        action = node.actions[node.tried]
        node.tried += 1
        node.closed()
        for above in node.line():
            above.pending += 1
        return node, action

    def takes_another_child(self, node: Node) -> bool:
        """Whether the search expands ``node`` and not a node below it."""
        if node.tried >= len(node.actions) or self.children is None or node.open_children == 0:
            return node.tried < len(node.actions)
        wide = (node.visits + node.pending) ** self.widening if self.widening else 0.0
        return node.tried < max(self.children, wide)


def bound(weight: float, node: Node) -> tuple[float, int]:
    """Upper confidence bound of a node; among equal bounds the lower action comes first."""
    tries = node.visits + node.pending
    return node.total / tries + weight / math.sqrt(tries) if tries else math.inf, -node.candidate.path[-1]


@dataclass(eq=False)
class Stop:
    """A half-denoised scene at a stop of the denoising; the root is noise."""

    level: int
    x: Tensor | None = None
    parent: Stop | None = None
    children: list[Stop] = field(default_factory=list)
    visits: int = 0
    total: float = 0.0

    def select(self, last: int, exploration: float, widening: float) -> Stop:
        """The first node on the way down that has fewer branches than its visits allow, or is at the last stop."""
        node = self
        while node.level < last and len(node.children) >= max(1.0, node.visits**widening):
            weight = exploration * math.sqrt(math.log(max(1, node.visits)))
            node = max(node.children, key=lambda stop: stop.total / stop.visits + weight / math.sqrt(stop.visits))
        return node

    def grow(self, child: Candidate) -> None:
        """Add the stops of a finished scene below this node, and its value to these stops and all their ancestors."""
        node, trace = self, getattr(child.state, "trace", None) or {}
        for x, promise in zip(trace.get("x", ()), trace.get("promises", ()), strict=True):
            node.children.append(Stop(node.level + 1, x, node, visits=1, total=float(promise)))
            node = node.children[-1]
        above: Stop | None = node
        while child.valid and above is not None:
            above.visits, above.total, above = above.visits + 1, above.total + child.value, above.parent


class Branches:
    """Steering of a denoising: begins it at noise or at a stop, and records the scenes at the later stops.

    Args:
        stops: shares of the denoising steps, increasing, each in (0, 1).
        begin: index of the stop at which the scenes begin; -1 for noise.
        x: (B, N, D) the scenes at that stop; None for noise.
        values: Φ (B,) of scenes.
    """

    def __init__(
        self, stops: Sequence[float], begin: int, x: Tensor | None, values: Callable[[SceneBatch], Tensor]
    ) -> None:
        self.stops, self.first, self.x, self.values = stops, begin, x, values
        self.places: list[Tensor] = []
        self.promises: list[Tensor] = []

    def at(self, steps: int) -> list[int]:
        """The step of every stop."""
        return [int(stop * steps) for stop in self.stops]

    def first_step(self, steps: int) -> int:
        """The step at which the denoising begins."""
        return 0 if self.first < 0 else self.at(steps)[self.first]

    def start(self, steps: int) -> tuple[int, Tensor] | None:
        """The step and the scenes that the denoising begins with; None for noise."""
        return None if self.x is None else (self.first_step(steps), self.x)

    def see(self, step: int, steps: int, x: Tensor) -> None:
        """Record the scenes x_t (B, N, D) if ``step`` is a later stop."""
        if step in self.at(steps)[self.first + 1 :]:
            self.places.append(x.cpu())

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch]) -> None:
        """Record the values Φ of the expected final scenes if ``step`` is a later stop."""
        if step in self.at(steps)[self.first + 1 :]:
            self.promises.append(self.values(denoised()))

    def trace(self, row: int) -> Mapping[str, Tensor]:
        """The stops of scene ``row``: its states ``x`` (M, N, D), and Φ of its expected scenes, ``promises`` (M,)."""
        if not self.places:
            return {}
        recorded = {"x": self.places, "promises": self.promises}
        return {name: torch.stack([values[row] for values in rows]).clone() for name, rows in recorded.items()}


@register_planner("tree_over_steps")
@dataclass(frozen=True)
class TreeOverStepsPlanner(PlannerSettings):
    """Diffusion tree sampling (Jain et al. 2025), in rounds of iterated repair.

    The inpaintings of a state form a tree. Its nodes are half-finished scenes at a few stops of the denoising, and its
    leaves are finished scenes. A round continues ``children`` new scenes from one node, chosen by its bound, each with
    its own noise; the steps before that node are not repeated. The value of a node is the mean over the finished scenes
    below it and its own expected scene. After ``rounds`` rounds the best finished scene becomes the current state,
    unless it scores less; in that case the tree grows further.

    Attributes:
        children: scenes per round, one batch of the denoiser; null takes ``branching``.
        stops: shares of the denoising steps at which scenes can be branched from.
        rounds: rounds per current state.
        exploration: weight of the bound.
        widening: exponent of progressive widening: a node of n visits has n^widening branches before the search goes
            below them.
    """

    name: str = "tree_over_steps"
    widens = True
    steers = True
    children: Count | None = None
    stops: tuple[float, ...] = (0.5, 0.7)
    rounds: Count = 3
    exploration: Annotated[float, at_least(0)] = 0.05
    widening: Annotated[float, at_least(0)] = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stops or any(not 0 < a < b for a, b in zip(self.stops, [*self.stops[1:], 1.0], strict=True)):
            raise InvalidInputError(f"planner {self.name}: stops={list(self.stops)} are no increasing shares, in 0..1")

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state; one that begins at a stop counts as a whole one.

        Raises:
            InvalidInputError: the expansions of ``problem`` cannot be steered.
        """
        steered = SteeredProblem(problem, self.name)
        ledger = SearchBudget(steered, budget, progress)
        state, actions, best = ledger.root, ledger.actions(ledger.root), None
        tree = Stop(-1)
        while ledger.left and actions:
            for _ in range(self.rounds):
                node = tree.select(len(self.stops) - 1, self.exploration, self.widening)
                taken, actions = actions[: self.children or 1], actions[self.children or 1 :]
                steered.steering = partial(self.branches, node)
                for child in ledger.expand([(state, action) for action in taken]):
                    node.grow(child)
                    if child.valid and (best is None or child.value > best.value):
                        best = child
            if best is not None and not best.value < state.value and ledger.actions(best):
                state, actions, best, tree = best, ledger.actions(best), None, Stop(-1)
        return ledger.result()

    def branches(self, node: Stop, pairs: Sequence[Any], values: Callable[[SceneBatch], Tensor]) -> Branches:
        """The steering of scenes that continue from ``node``."""
        x = None if node.x is None else node.x.expand(len(pairs), *node.x.shape)
        return Branches(self.stops, node.level, x, values)


def systematic(weights: np.ndarray, uniform: float) -> np.ndarray:
    """(K,) index of the particle that each place continues with: systematic resampling (Carpenter et al. 1999). A
    particle with share w_i of the sum of the weights (K,) gets K w_i places on average over ``uniform`` in [0, 1), and
    always K w_i rounded down or up. A particle that gets any place keeps its own.
    """
    count = len(weights)
    edges = np.cumsum(weights)
    drawn = np.searchsorted(edges / edges[-1], (np.arange(count) + uniform) / count, side="right").clip(max=count - 1)
    rows = np.full(count, -1)
    survivors, repeats = np.unique(drawn, return_counts=True)
    rows[survivors] = survivors
    rows[rows < 0] = np.repeat(survivors, repeats - 1)
    return rows


class Particles:
    """Resampler of groups of particles, the children of one parent (``parents`` (B,) are hashable and have a generator
    each in ``rngs``) that are denoised in one batch. At ``resamplings`` steps the weights are exp(strength * (value -
    value at the last resampling)), whose product along a path is exp(strength * last value) (Singhal et al. 2025,
    difference potential). ``values`` gives Φ (B,) of denoised scenes.
    """

    def __init__(
        self,
        parents: Sequence[Any],
        rngs: dict[Any, np.random.Generator],
        values: Callable[[SceneBatch], Tensor],
        resamplings: int,
        begin: float,
        strength: float,
    ) -> None:
        self.groups = {parent: np.flatnonzero([parent == other for other in parents]) for parent in rngs}
        self.rngs, self.values = rngs, values
        self.resamplings, self.begin, self.strength = resamplings, begin, strength
        self.before = np.zeros(len(parents))

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch]) -> Tensor | None:
        """(B,) index of the particle that each place continues with; None at a step without resampling."""
        if step not in self.at(steps):
            return None
        now = self.values(denoised()).double().numpy()
        rows = np.arange(len(now))
        for parent, group in self.groups.items():
            log_weights = self.strength * (now[group] - self.before[group])
            rows[group] = group[systematic(np.exp(log_weights - log_weights.max()), self.rngs[parent].random())]
        self.before = now[rows]
        return torch.from_numpy(rows)

    def at(self, steps: int) -> list[int]:
        """Steps at which particles are resampled: evenly spaced from ``begin`` on, without the last."""
        first = int(self.begin * steps)
        return sorted({first + (i * (steps - 1 - first)) // self.resamplings for i in range(self.resamplings)})


@register_planner("feynman_kac")
@dataclass(frozen=True)
class FeynmanKacPlanner(PlannerSettings):
    """Feynman-Kac steering of every inpainting (Singhal et al. 2025), in rounds of iterated repair.

    A round denoises ``particles`` inpaintings of the current state in one batch. During the denoising, the objective
    scores the scene that the network expects of each particle, and particles with higher scores replace others. The
    finished scenes are treated as in :class:`~agents.planning.GreedyPlanner`. Resampling costs evaluations of the
    objective, but none of the denoiser.

    Attributes:
        particles: number of inpaintings per round, one batch of the denoiser.
        resamplings: number of resamplings per round.
        begin: share of the denoising steps before the first resampling.
        strength: λ in the weight exp(λ Φ) of a particle; 0 resamples nothing.
    """

    name: str = "feynman_kac"
    widens = True
    steers = True
    particles: Count = 8
    resamplings: Count = 2
    begin: Annotated[float, BELOW_ONE] = 0.7
    strength: Annotated[float, at_least(0)] = 50.0

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state.

        Raises:
            InvalidInputError: the expansions of ``problem`` cannot be steered.
        """
        steered = SteeredProblem(problem, self.name, self.steering)
        return GreedyPlanner(children=self.particles).plan(steered, budget, progress)

    def steering(self, pairs: Sequence[tuple[Any, int]], values: Callable[[SceneBatch], Tensor]) -> Particles:
        """The resampling of the inpaintings of ``pairs``, with a random generator for each parent."""
        parents, rngs = [(state.seed, state.path) for state, _ in pairs], {}
        for (seed, path), (_, action) in zip(parents, pairs, strict=True):
            if (seed, path) not in rngs:  # spawn keys 0 and 1 are for the noise and the mask of the child
                source = np.random.SeedSequence(entropy=seed, spawn_key=(*path, action, 2))
                rngs[seed, path] = np.random.default_rng(source)
        return Particles(parents, rngs, values, self.resamplings, self.begin, self.strength)


if __name__ == "__main__":
    sys.exit(main(["search", *sys.argv[1:]]))
