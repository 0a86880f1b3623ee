"""Gymnasium adapter of the search MDP: a choice among inpaintings of a scene per step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from torch import Tensor

from scene_envs.envs.search import SearchProblem, SearchState, Steering
from scene_envs.envs.settings import SearchMaskSettings, SearchSettings, takes
from scene_envs.envs.spaces import (
    STATE_BOUND,
    ResetNeededError,
    SpecMixin,
    check_render_mode,
    occupied,
    picture,
    scene_box,
)
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

Observation = dict[str, np.ndarray]


class SearchEnv(SpecMixin, gym.Env[Any, Any]):
    """Inference-time search over partial scenes as an environment.

    ## Description

    A state is a scene with a mask of the slots to regenerate. By default the mask holds the objects that the objective
    blames, and all empty slots. The scene prior makes `branching` inpaintings of these slots, and an action chooses one
    of the inpaintings (Pfaff et al. 2025, inference-time search).

    Planners work on states directly: `clone_state`, `restore_state`, `legal_actions`, `action_masks`, `expand`,
    `expand_batch`, `evaluate`, `best_state`. A state is immutable and picklable and holds no simulator. The random
    numbers of a child depend only on the root's seed and the child's path, so a tree does not depend on the order of
    its expansion. Batches of different sizes may differ in the network's rounding, by about 1e-6.

    ## Action Space

    `Discrete(branching)`: which inpainting. All actions are legal until the episode ends.

    ## Observation Space

    A `Dict` with the keys

    | key | space | meaning |
    |---|---|---|
    | `scene` | `Box(-10, 10, (N, D), float32)` | the scene, normalised |
    | `object_mask` | `MultiBinary(N)` | slots that are not *empty* |
    | `regenerate` | `MultiBinary(N)` | slots that the next action regenerates |
    | `depth` | `Box(0, max_depth, (1,), int64)` | actions taken |
    | `value` | `Box(0, 1, (1,), float32)` | Φ of the scene, see Rewards |
    | `prompt` | `Box(0, V-1, (L,), int64)` | tokens of the prompt, padded with 0; only if `prompt=` is given |

    `info` holds the same numbers at every reset and step: `depth`, `value` (Φ), `objective` (raw), `reward_valid` (0 or
    1), `objects` (slots that are not empty, welded ones included), `regenerate` (slots in the mask), `best_value`
    (highest Φ since the reset) and `nfe` (denoiser evaluations since the reset, including those of planners).

    ## Rewards

    The reward is Φ(s') - Φ(s). Φ is the objective's value divided by `objective_scale`, clipped to [0, 1]. The
    rewards of an episode add up to Φ(end) - Φ(root). If the objective cannot score the child, the child takes the
    parent's Φ, so the reward is 0, and `info["reward_valid"]` is 0.

    ## Starting State

    An episode starts from a sample of the prior; `self.np_random` draws the sample's seed. `reset(options={"state":
    state})` starts from a given `SearchState` instead, and `options={"scene": batch}` from a given scene.

    ## Episode End

    The episode is `terminated` when nothing is left to improve: no slot is masked, or Φ is 1. It is `truncated` at
    depth `max_depth`, or when `max_nfe` denoiser evaluations are spent since the reset. If one of these holds at the
    reset already, the first step ends the episode where it began, with reward 0.

    ## Arguments

    ```python
    import gymnasium as gym

    env = gym.make("scene_envs:SceneEnvs/Search-v0", scene="dimsum_table", objective="feasible_objects", branching=4)
    ```

    | argument | default | meaning |
    |---|---|---|
    | `scene` | `None` | scene type; `None` is that of the prior, `"dimsum_table"` without one |
    | `objective` | `"feasible_objects"` | any reward: name, mapping, function or object |
    | `branching` | `4` | inpaintings to choose from |
    | `max_depth` | `10` | actions per episode |
    | `num_steps` | `50` | denoising steps per inpainting |
    | `prior` | `None` | name, path or prior; `None` is the shipped prior of the scene type |
    | `slots` | `None` | slots per scene; `None` is the scene type's number, more is allowed |
    | `mask` | `"blamed_or_empty"` | [mask](../search.md#masks): a name, a mapping with its settings, or a function |
    | `objective_scale` | `None` | objective at which Φ = 1; `None` is the largest it declares, else the free slots |
    | `max_nfe` | `None` | denoiser evaluations per episode; `None` is any number |
    | `workers` | `0` | processes for physics in the objective; 0: in the calling process; `"ray"`: on a Ray cluster |
    | `physics` | `"auto"` | engine of motion: `bullet`, `mujoco`, `warp`; `auto`: Bullet if installed, else MuJoCo |
    | `device` | `"auto"` | device of the network: `cpu`, `cuda`; `auto`: of a given prior, else the GPU if any |
    | `render_mode` | `None` | `"rgb_array"`: pictures, masked objects in red |
    | `prompt` | `None` | text that all scenes should satisfy, for priors that read prompts; the objective gets it too |
    | `guidance` | `0.0` | weight of classifier-free guidance, which doubles the NFE; needs a prompt |
    | `claim_guidance` | `0.0` | strength of guidance to the numbers and places that the prompt gives; needs a prompt |
    | `physics_guidance` | `0.0` | strength with which objects are moved out of overlaps and onto supports, 0 to 1 |

    ## Vectorized environment

    `gym.make_vec("scene_envs:SceneEnvs/Search-v0", num_envs=4, ...)` runs copies one after another. Planners should use
    `expand_batch`, which denoises many children in one batch.

    torchrl's `GymWrapper` takes one environment or copies with `vector_kwargs={"autoreset_mode": "Disabled"}`.

    ## Version History

    * v0: initial version.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012  (declared so by gym.Env)

    @takes(SearchSettings)
    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.problem = problem = SearchProblem(**settings)
        self._chooses = "masks" in settings
        choice = spaces.Box(0, 1, (len(problem.mask_names), problem.slots), np.int8)
        self.observation_space = spaces.Dict(
            {
                "scene": scene_box(STATE_BOUND, problem.slots, problem.scene_type.features),
                "object_mask": spaces.MultiBinary(problem.slots),
                "regenerate": choice if self._chooses else spaces.MultiBinary(problem.slots),
                "depth": spaces.Box(0, problem.max_depth, (1,), np.int64),
                "value": spaces.Box(0.0, 1.0, (1,), np.float32),
            }
        )
        self._tokens: np.ndarray | None = None
        if problem.prompt is not None and problem.prompting.space is not None:
            length, words = problem.prompting.space
            self.observation_space["prompt"] = spaces.Box(0, words - 1, (length,), np.int64)
            self._tokens = problem.prompting.read([problem.prompt])[0].numpy()
        self.action_space = spaces.Discrete(problem.num_actions)
        self._state: SearchState | None = None
        self._begun = False
        self._best: SearchState | None = None
        self._nfe_at_reset = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start from a sample of the prior.

        Args:
            seed: Seed of ``self.np_random``, which draws the seed of the tree.
            options: ``{"state": SearchState}`` or ``{"scene": SceneBatch of 1}`` to start from.
        """
        super().reset(seed=seed)
        options = options or {}
        self._nfe_at_reset = self.problem.evaluations
        tree_seed = int(self.np_random.integers(2**63))
        if "state" in options:
            self._state = self._check_state(options["state"])
        else:
            self._state = self.problem.root(tree_seed, options.get("scene"))
        self._best = self._state
        self._begun = False
        return self._observe(self._state)

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move to the chosen inpainting.

        Raises:
            InvalidInputError: no such action.
            ResetNeededError: the episode has ended or never began.
        """
        parent = self.state
        if why := self._end(parent):
            if not self._begun:  # nothing to improve at the reset: the first step ends the episode
                self._begun = True
                observation, info = self._observe(parent)
                solved = self.problem.is_solved(parent)
                return observation, 0.0, solved, not solved, info
            raise ResetNeededError(f"the episode ended, {why}; call reset() first")
        self._begun = True
        is_action = isinstance(action, int | np.integer) and 0 <= action < self.problem.num_actions
        if is_action and not bool(self.problem.mask_of(parent, action).any()):
            self._state = replace(parent, depth=parent.depth + 1, path=(*parent.path, int(action)))
        else:
            self._state = self.expand(parent, action)
        observation, info = self._observe(self._state)
        terminated = self.problem.is_solved(self._state)
        truncated = not terminated and bool(self._end(self._state))
        return observation, self._state.value - parent.value, terminated, truncated, info

    def _end(self, state: SearchState) -> str:
        """Reason why the episode ends at ``state``; empty where it goes on."""
        if self.problem.is_solved(state):
            return "with nothing left to improve"
        if state.depth >= self.problem.max_depth:
            return f"at max_depth={self.problem.max_depth}"
        max_nfe = self.problem.max_nfe
        if max_nfe is not None and self.nfe + self.problem.nfe_per_scene > max_nfe:
            return f"as max_nfe={max_nfe} denoiser evaluations are spent"
        return ""

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(H, W, 3) uint8 picture of the current scene, masked objects in red; None without a render mode."""
        if self.render_mode is None:
            return None
        return picture(self.scene(), highlight=self.state.mask.unsqueeze(0))[0]

    def close(self) -> None:
        """Stop physics workers, if any."""
        self.problem.close()

    @property
    def state(self) -> SearchState:
        """The current state."""
        if self._state is None:
            raise ResetNeededError("the search has no state yet; call reset() first")
        return self._state

    def clone_state(self) -> SearchState:
        """The current state, which is immutable and therefore not copied."""
        return self.state

    def restore_state(self, state: SearchState) -> None:
        """Make ``state`` the current one. The best state and the NFE count are kept."""
        self._state = self._check_state(state)
        self._remember([self._state])

    def legal_actions(self, state: SearchState | None = None) -> Sequence[int]:
        """Actions of ``state`` (default: the current one); none at ``max_depth`` or with nothing left to improve."""
        return self.problem.legal_actions(self.state if state is None else state)

    def action_masks(self) -> np.ndarray:
        """(number of actions,) bool, the legal ones of the current state, in the form that maskable agents expect."""
        return np.isin(np.arange(self.problem.num_actions), list(self.legal_actions()))

    def expand(self, state: SearchState, action: int) -> SearchState:
        """The child of ``state`` under ``action``; the current state stays."""
        return self.expand_batch([(state, action)])[0]

    def expand_batch(
        self, pairs: Sequence[tuple[SearchState, int]], steering: Steering | None = None
    ) -> list[SearchState]:
        """The children of (state, action) pairs, denoised as one batch; the current state stays.

        ``steering`` acts on the scenes while they are denoised (:data:`scene_envs.envs.search.Steering`).
        """
        children = self.problem.expand_batch(pairs, steering)
        self._remember(children)
        return children

    def evaluate(self, state: SearchState | None = None) -> float:
        """Φ of ``state`` (default: the current one), in [0, 1]; it was computed when the state was made."""
        return (self.state if state is None else state).value

    def best_state(self) -> SearchState:
        """The state of highest Φ seen since the reset, by steps or by expansion; the earliest among equals."""
        if self._best is None:
            raise ResetNeededError("the search has no state yet; call reset() first")
        return self._best

    def without_masked(self, state: SearchState) -> SearchState:
        """``state`` with the objects that are still masked removed; the current state stays."""
        return self.problem.without_masked(state)

    def with_scene(self, state: SearchState, scene: Tensor) -> SearchState:
        """``state`` with another ``scene`` (N, D), scored and masked again; nothing is denoised."""
        return self.problem.with_scene(state, scene)

    def scene(self, state: SearchState | None = None) -> SceneBatch:
        """The scene of ``state`` (default: the current one), as a batch of one."""
        state = self.state if state is None else state
        return SceneBatch(state.scene.unsqueeze(0), self.problem.scene_type)

    @property
    def nfe(self) -> int:
        """Denoiser evaluations since the reset."""
        return self.problem.evaluations - self._nfe_at_reset

    def _check_state(self, state: Any) -> SearchState:
        if not isinstance(state, SearchState):
            raise InvalidInputError(
                f"a SearchState is needed, as clone_state() or expand() gives, not {type(state).__name__}"
            )
        shape = (self.problem.slots, self.problem.scene_type.features)
        if tuple(state.scene.shape) != shape:
            raise InvalidInputError(f"the state's scene has shape {tuple(state.scene.shape)}, here scenes are {shape}")
        names = self.problem.mask_names
        if len(state.masks) != len(names):
            raise InvalidInputError(f"the state has {len(state.masks)} masks, this environment {len(names)}: {names}")
        return state

    def _remember(self, states: Sequence[SearchState]) -> None:
        for state in states:
            if state.valid and (self._best is None or not self._best.valid or state.value > self._best.value):
                self._best = state

    def _observe(self, state: SearchState) -> tuple[Observation, dict[str, Any]]:
        scene = self.scene(state)
        normalised = scene.to_tensor(normalised=self.problem.prior.normalizer)[0].clamp(-STATE_BOUND, STATE_BOUND)
        present = occupied(scene.tensor, scene.scene_type)[0].numpy()
        observation = {
            "scene": normalised.numpy(),
            "object_mask": present,
            "regenerate": (state.masks if self._chooses else state.mask).numpy().astype(np.int8),
            "depth": np.array([state.depth], np.int64),
            "value": np.array([state.value], np.float32),
        }
        if self._tokens is not None:
            observation["prompt"] = self._tokens.copy()
        info = {
            "depth": state.depth,
            "value": state.value,
            "objective": state.objective,
            "reward_valid": int(state.valid),
            "objects": int(present.sum()),
            "regenerate": int(state.mask.sum()),
            "best_value": self.best_state().value,
            "nfe": self.nfe,
        }
        return observation, info


class SearchMaskEnv(SearchEnv):
    """Inference-time search over partial scenes as an environment, with a choice of what to regenerate.

    ## Description

    This environment is [Search-v0](search.md) with K masks per state instead of one. An action chooses a mask and one
    of the scene prior's `branching` inpaintings of that mask's slots. Which mask is best depends on the scene: a
    crowded scene needs repair, a scene without faults has room for more objects, and a scene in which repair fails
    needs a larger change. An agent can learn this choice; [maskable_ppo.py](../../examples/maskable_ppo.py) trains one
    with MaskablePPO of sb3-contrib.

    Planners use the same methods as in `Search-v0`: `clone_state`, `restore_state`, `legal_actions`, `action_masks`,
    `expand`, `expand_batch`, `evaluate`, `best_state`. All masks of a state use the same random numbers, which depend
    on the root's seed and the path. With one mask the tree equals that of `Search-v0`, bit for bit.

    ## Action Space

    `Discrete(K * branching)`: action `k * branching + j` is inpainting j of mask k. An action is legal if its mask has
    a slot. `action_masks()` marks the legal actions in the form that MaskablePPO expects. `legal_actions()` lists the
    first inpainting of every mask before the second of any, so a planner that expands a few actions tries all masks.
    `step` with an illegal action leaves the scene unchanged; it counts as a step of `max_depth` and costs no denoiser
    evaluations. `expand` refuses an illegal action.

    ## Observation Space

    The `Dict` of [Search-v0](search.md#observation-space), but `regenerate` is `Box(0, 1, (K, N), int8)`: the slots that
    each mask regenerates. `info` has the same keys; its `regenerate` is the number of slots that are in any mask.

    ## Rewards

    Φ(s') - Φ(s), as in [Search-v0](search.md#rewards).

    ## Starting State

    As in [Search-v0](search.md#starting-state); a state that is given has as many masks.

    ## Episode End

    As in [Search-v0](search.md#episode-end); nothing is left to improve where no mask has a slot, or Φ is 1.

    ## Arguments

    ```python
    import gymnasium as gym

    masks = ["culprits", "infeasible_or_empty", {"name": "empty", "count": 4}]
    env = gym.make("scene_envs:SceneEnvs/SearchMask-v0", scene="dimsum_table", masks=masks, branching=4)
    ```

    | argument | default | meaning |
    |---|---|---|
    | `masks` | `('culprits', 'infeasible', 'empty', 'infeasible_or_empty')` | the K [masks](../search.md#masks): names, mappings with settings, functions |

    The other arguments are those of [Search-v0](search.md#arguments), without `mask`; `branching` counts the
    inpaintings of each mask.

    ## Vectorized environment

    As in [Search-v0](search.md#vectorized-environment).

    ## Version History

    * v0: initial version.
    """  # noqa: E501  (rows of a table)

    @takes(SearchMaskSettings)
    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        super().__init__(render_mode=render_mode, **{"masks": SearchMaskSettings.masks, **settings})
