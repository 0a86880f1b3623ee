"""Search MDP: states, and pure functions that make roots, children and values."""

from __future__ import annotations

import hashlib
import inspect
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.masks import MaskGenerator, mask_for_prompt, masked_slots, resolve_mask
from scene_envs.envs.scoring import EnvPrompts, RewardScorer, Score, prior_device
from scene_envs.envs.settings import SearchMaskSettings, SearchSettings, check_physics_guidance, takes
from scene_envs.envs.spaces import check_slots, resolve_scene_and_prior
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

_LOGGER = logging.getLogger(__name__)
_SAME = 1e-4
"""Scenes are the same when their objects agree to within this (m)."""

Steering = Callable[[int, int, Callable[[], SceneBatch], Tensor], Tensor | None]
"""``(step, steps, denoised, std) -> shift``: the ``guide`` of a prior's ``inpaint``, which moves scenes while they are
denoised.
"""


@dataclass(frozen=True, eq=False)
class SearchState:
    """A partial scene, with the slots to regenerate and the actions that led to it. Immutable and picklable.

    Attributes:
        scene: (N, D) float32 raw scene; never write into it.
        masks: (K, N) bool, slots that each mask to choose from regenerates; K is 1 without a choice.
        depth: Number of actions since the root.
        path: Actions since the root.
        seed: Seed of the root; with ``path`` it fixes all random numbers of this state and of those below it.
        value: Φ in [0, 1]; the parent's where ``valid`` is False.
        objective: Raw value of the objective; 0 where not valid.
        valid: Whether the objective could score this scene.

    Two states are equal when they are the same node: same seed, path, scene and masks.
    """

    scene: Tensor
    masks: Tensor
    depth: int
    path: tuple[int, ...]
    seed: int
    value: float
    objective: float
    valid: bool

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SearchState):
            return NotImplemented
        same_node = (self.seed, self.path) == (other.seed, other.path)
        return same_node and torch.equal(self.scene, other.scene) and torch.equal(self.masks, other.masks)

    def __hash__(self) -> int:
        return hash((self.seed, self.path))

    @property
    def mask(self) -> Tensor:
        """(N,) bool, slots that the next action may regenerate."""
        return self.masks.any(dim=0)

    @property
    def fingerprint(self) -> bytes:
        """Digest of the scene as a set of objects, to a tenth of a millimetre: equal for equal scenes."""
        rows = torch.round(self.scene / _SAME).to(torch.int32).numpy()
        return hashlib.blake2b(b"".join(sorted(row.tobytes() for row in rows)), digest_size=16).digest()


def node_randomness(seed: int, path: tuple[int, ...]) -> tuple[torch.Generator, np.random.Generator]:
    """The independent sources of random numbers of the node at ``path`` below the root of ``seed``, functions of these
    two alone: one for the diffusion that makes the node's scene, and one for the node's masks.

    >>> node_randomness(7, (0, 2))[0].initial_seed() == node_randomness(7, (0, 2))[0].initial_seed()
    True
    """
    noise, mask = np.random.SeedSequence(entropy=seed, spawn_key=path).spawn(2)
    start = int(noise.generate_state(1, np.uint64)[0] >> np.uint64(1))
    return torch.Generator().manual_seed(start), np.random.default_rng(mask)


class SearchProblem:
    """Generator of the tree of partial scenes (Pfaff et al. 2025, inference-time search by inpainting).

    Every function of a state is deterministic. Noise and masks come from the state's own seed and path, so a
    subtree does not depend on the order of expansion. Expanding in different batches may change the network's
    rounding by about 1e-6, never the random numbers.

    With ``masks`` in place of ``mask`` an action also chooses the mask of slots to regenerate: action ``k * branching +
    j`` is inpainting j of mask k. It is legal where mask k has a slot.

    Args:
        **settings: Fields of :class:`~scene_envs.envs.settings.SearchSettings`, or of
            :class:`~scene_envs.envs.settings.SearchMaskSettings`.

    Attributes:
        evaluations: Number of denoiser evaluations (NFE) so far, ``num_steps`` per generated scene and twice that many
            with guidance.
        num_actions: Number of actions of a state, legal or not.
        mask_generators: The K masks.
        mask_names: Their names, in the order of the actions.

    >>> problem = SearchProblem(objective="object_count", num_steps=2, max_depth=1)
    >>> root = problem.root(seed=0)
    >>> children = problem.expand_batch([(root, action) for action in problem.legal_actions(root)])
    >>> [child.path for child in children], problem.evaluations
    ([(0,), (1,), (2,), (3,)], 10)
    >>> problem = SearchProblem(objective="object_count", num_steps=2, masks=["empty", "random"], branching=2)
    >>> list(problem.legal_actions(problem.root(seed=0)))
    [0, 2, 1, 3]
    """

    @takes(SearchSettings)
    def __init__(self, **settings: Any) -> None:
        chosen = SearchMaskSettings(**settings) if "masks" in settings else SearchSettings(**settings)
        masks = chosen.masks if isinstance(chosen, SearchMaskSettings) else [chosen.mask]
        self.scene_type, self.prior = resolve_scene_and_prior(chosen.scene, chosen.prior, chosen.device)
        self.slots = check_slots(self.scene_type, chosen.slots)
        self.device = prior_device(self.prior)
        self.branching, self.max_depth, self.num_steps = chosen.branching, chosen.max_depth, chosen.num_steps
        self.num_actions, self.max_nfe = len(masks) * chosen.branching, chosen.max_nfe
        self.claim_guidance, self.physics_guidance = chosen.claim_guidance, chosen.physics_guidance
        check_physics_guidance(self.physics_guidance, self.scene_type)
        self._may_be_guided = "physics_guidance" in inspect.signature(self.prior.inpaint).parameters
        self.prior.step_table(self.num_steps)  # raises if the prior has fewer steps
        self.prompting = EnvPrompts(self.prior, chosen.prompt, chosen.guidance, self.slots)
        self.prompt = self.prompting.draw(np.random.default_rng(0)) if self.prompting.given else None
        self.scorer = RewardScorer(chosen.objective, chosen.workers, chosen.physics, prompted=self.prompting.given)
        if self.scorer.depends_on_batch:
            raise InvalidInputError(
                f"objective={chosen.objective!r} scores a scene by the other scenes of its batch, and a search "
                "compares scenes of different batches; take another objective"
            )
        free_slots = self.slots - len(self.scene_type.fixed)
        declared = self.scorer.maximum(self.slots, free_slots) if chosen.objective_scale is None else None
        self.scale = chosen.objective_scale or declared or float(free_slots)
        self.evaluations = 0
        self._warned_of_scale = self._warned_of_zero = False
        self.mask_generators = [mask_for_prompt(resolve_mask(mask), self.prompt) for mask in masks]
        self.mask_names = tuple(map(_name, masks))

    def root(self, seed: int, scene: SceneBatch | None = None) -> SearchState:
        """The root of ``seed``: ``scene`` (a batch of one), or a sample of the prior."""
        if scene is None:
            empty = SceneBatch.empty(self.scene_type, 1, self.slots)
            everything = torch.ones(1, self.slots, dtype=torch.bool)
            everything[:, : len(self.scene_type.fixed)] = False
            scene = self._inpaint(empty, everything, [node_randomness(seed, ())[0]])
        elif len(scene) != 1 or scene.tensor.shape[1] != self.slots or scene.scene_type.name != self.scene_type.name:
            raise InvalidInputError(
                f"the root must be one {self.scene_type.name!r} scene of {self.slots} slots, not {scene}"
            )
        return self._score(scene, [(seed, (), 0.0)])[0]

    def expand_batch(
        self, pairs: Sequence[tuple[SearchState, int]], steering: Steering | None = None
    ) -> list[SearchState]:
        """The children of (state, action) pairs, generated as one batch and scored as one batch.

        Raises:
            InvalidInputError: an action is not legal in its state.
        """
        if not pairs:
            return []
        for state, action in pairs:
            self._check_legal(state, action)
        paths = [(*state.path, int(action)) for state, action in pairs]
        parents = SceneBatch(torch.stack([state.scene for state, _ in pairs]), self.scene_type)
        masks = torch.stack([self.mask_of(state, action) for state, action in pairs])
        noises = [node_randomness(state.seed, path)[0] for (state, _), path in zip(pairs, paths, strict=True)]
        children = self._inpaint(parents, masks, noises, steering)
        origins = [(state.seed, path, state.value) for (state, _), path in zip(pairs, paths, strict=True)]
        return self._score(children, origins)

    def legal_actions(self, state: SearchState) -> Sequence[int]:
        """The inpaintings of masks that have a slot; none at ``max_depth`` and where nothing is left to improve. One
        inpainting of every mask comes before the second of any, so that the first few actions try all masks.
        """
        if state.depth >= self.max_depth or self.is_solved(state):
            return ()
        if len(state.masks) == 1:
            return range(self.branching)
        masks = torch.nonzero(state.masks.any(dim=1)).flatten().tolist()
        return [mask * self.branching + child for child in range(self.branching) for mask in masks]

    def mask_of(self, state: SearchState, action: int) -> Tensor:
        """(N,) bool, the slots that ``action`` regenerates in ``state``."""
        return state.masks[action // self.branching]

    def is_solved(self, state: SearchState) -> bool:
        """Whether nothing is left to improve: no slot is masked, or Φ is 1, its largest value."""
        return state.value >= 1.0 or not bool(state.masks.any())

    def without_masked(self, state: SearchState) -> SearchState:
        """The same node without the objects that are still masked."""
        empty = SceneBatch.empty(self.scene_type, 1, self.slots).tensor[0]
        return self.with_scene(state, torch.where(state.mask[:, None], empty, state.scene))

    def with_scene(self, state: SearchState, scene: Tensor) -> SearchState:
        """The node of ``state`` with another ``scene`` (N, D), scored and masked again; nothing is denoised."""
        batch = SceneBatch(scene.unsqueeze(0), self.scene_type)
        return self._score(batch, [(state.seed, state.path, state.value)])[0]

    def _check_legal(self, state: SearchState, action: int) -> None:
        if not isinstance(action, (int, np.integer)) or not 0 <= action < self.num_actions:
            raise InvalidInputError(f"action={action!r}: choose one of the inpaintings 0..{self.num_actions - 1}")
        if state.depth >= self.max_depth:
            raise InvalidInputError(
                f"the state at path {state.path} is at max_depth={self.max_depth}: it has no children"
            )
        if self.is_solved(state):
            raise InvalidInputError(f"nothing is left to improve in the state at path {state.path}: it has no children")
        if not bool(self.mask_of(state, action).any()):
            name = self.mask_names[action // self.branching]
            raise InvalidInputError(
                f"action={action}: mask {name!r} has no slot in the state at path {state.path}; legal actions are "
                f"{sorted(self.legal_actions(state))}"
            )

    @property
    def nfe_per_scene(self) -> int:
        """Denoiser evaluations per generated scene."""
        return self.num_steps * (2 if self.prompting.guidance else 1)

    def _inpaint(
        self, batch: SceneBatch, masks: Tensor, noises: list[torch.Generator], guide: Steering | None = None
    ) -> SceneBatch:
        guidance, reader = self.prompting.guidance, self.prompting.reader
        self.evaluations += self.nfe_per_scene * len(batch)
        batch, masks = batch.to(self.device), masks.to(self.device)
        how: dict[str, Any] = {"num_steps": self.num_steps, "generators": noises}
        if guide is not None:
            _check_takes(self.prior, "guide", "choose a planner that does not steer the denoising, such as evolution")
            how["guide"] = guide
        if self.physics_guidance:
            _check_takes(self.prior, "physics_guidance", "leave physics_guidance=0")
        if self.physics_guidance or self._may_be_guided:
            how["physics_guidance"] = self.physics_guidance  # also 0, because some priors are guided by default
        if reader is None or self.prompt is None:
            return self.prior.inpaint(batch, masks, **how).to("cpu")
        if self.claim_guidance:
            _check_takes(self.prior, "claim_guidance", "leave claim_guidance=0")
            how["claim_guidance"] = self.claim_guidance
        return reader.inpaint(batch, masks, prompt=self.prompt, guidance=guidance, **how).to("cpu")

    def _score(self, batch: SceneBatch, origins: Sequence[tuple[int, tuple[int, ...], float]]) -> list[SearchState]:
        """States of ``batch``, given each one's (seed, path, value of the parent)."""
        score = self.scorer(batch, None if self.prompt is None else [self.prompt] * len(batch))
        return [self._state(batch[i], score.row(i), *origin) for i, origin in enumerate(origins)]

    def _state(
        self, scene: SceneBatch, score: Score, seed: int, path: tuple[int, ...], parent_value: float
    ) -> SearchState:
        valid, objective = bool(score.valid[0]), float(score.value[0])
        if objective > self.scale and not self._warned_of_scale:
            self._warned_of_scale = True
            _LOGGER.warning(
                "the objective is %.4g, more than objective_scale=%.4g: its value in the search is clipped to 1; raise "
                "objective_scale to search further",
                objective,
                self.scale,
            )
        if valid and objective < 0 and not self._warned_of_zero:
            self._warned_of_zero = True
            _LOGGER.warning(
                "the objective is %.4g: below 0 the search cannot compare scenes; shift it, as with "
                "{name: weighted_sum, rewards: [...], offset: minus the value that becomes 0}",
                objective,
            )
        return SearchState(
            scene=scene.tensor[0].clone(),
            masks=torch.stack([self._mask(generator, scene, score, seed, path) for generator in self.mask_generators]),
            depth=len(path),
            path=path,
            seed=seed,
            value=float(np.clip(objective / self.scale, 0.0, 1.0)) if valid else parent_value,
            objective=objective,
            valid=valid,
        )

    def _mask(
        self, generator: MaskGenerator, scene: SceneBatch, score: Score, seed: int, path: tuple[int, ...]
    ) -> Tensor:
        """(N,) bool: slots that ``generator`` masks at this node, or all if no object is free; welded ones left out."""
        changeable = ~scene.is_welded[0]
        changeable[: len(self.scene_type.fixed)] = False
        if bool(scene.is_free.any()):
            changeable &= masked_slots(generator, scene, score, node_randomness(seed, path)[1])
        return changeable

    def close(self) -> None:
        """Stop physics workers, if any."""
        self.scorer.close()


def _check_takes(prior: Any, role: str, remedy: str) -> None:
    """Refuse to steer or guide the inpaintings of a prior that does not take ``role``."""
    keys = inspect.signature(prior.inpaint).parameters.values()
    if not any(key.name == role or key.kind is inspect.Parameter.VAR_KEYWORD for key in keys):
        raise InvalidInputError(f"inpaint of {type(prior).__name__} takes no {role}=; {remedy}")


def _name(mask: Any) -> str:
    """A mask's name as a user gives it; for a function, the function's own name."""
    if isinstance(mask, str):
        return mask
    return str(mask["name"]) if hasattr(mask, "keys") else getattr(mask, "__name__", type(mask).__name__)
