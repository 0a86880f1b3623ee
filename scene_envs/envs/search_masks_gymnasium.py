"""Gymnasium adapter of the search MDP with a choice of masks: which slots to regenerate, and which inpainting."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces

from scene_envs.envs.search import SearchState
from scene_envs.envs.search_gymnasium import Observation, SearchEnv
from scene_envs.envs.search_masks import MaskChoiceProblem
from scene_envs.envs.settings import SearchMaskSettings, takes
from scene_envs.errors import InvalidInputError


class SearchMaskEnv(SearchEnv):
    """Inference-time search over partial scenes as an environment, with a choice of what to regenerate.

    ## Description

    As [Search-v0](search.md), but a state has K masks instead of one, and an action chooses both a mask and one of
    `branching` inpaintings of its slots by the scene prior. Which mask is best depends on the scene: a crowded one
    needs repair, one without faults has room for more, and one that is stuck needs a larger change. An agent can
    learn that; [maskable_ppo.py](../../examples/maskable_ppo.py) does with MaskablePPO of sb3-contrib.

    Planners use the state as in `Search-v0`, with the same methods: `clone_state`, `restore_state`, `legal_actions`,
    `action_masks`, `expand`, `expand_batch`, `evaluate`, `best_state`. All masks of a state are drawn from the same
    random numbers, a function of the root's seed and the path; with one mask the tree is that of `Search-v0`, bit for
    bit.

    ## Action Space

    `Discrete(K * branching)`: action `k * branching + j` is inpainting j of mask k. An action is legal where its mask
    has a slot. `action_masks()` tells the legal ones, as MaskablePPO asks for them. `legal_actions()` lists an
    inpainting of every mask before the second of any, so that a planner that expands a few actions tries all masks.
    `step` with another action leaves the scene as it is: it costs a step of `max_depth` and no denoiser evaluations.
    `expand` refuses it.

    ## Observation Space

    `Dict` of

    | key | space | meaning |
    |---|---|---|
    | `scene` | `Box(-10, 10, (N, D), float32)` | the scene, normalised |
    | `object_mask` | `MultiBinary(N)` | slots that are not *empty* |
    | `regenerate` | `MultiBinary((K, N))` | slots that each mask regenerates |
    | `depth` | `Box(0, max_depth, (1,), int64)` | actions taken |
    | `value` | `Box(0, 1, (1,), float32)` | Φ of the scene |

    `info` is that of `Search-v0`; `regenerate` there is the number of slots in any mask.

    ## Rewards

    Φ(s') - Φ(s), with Φ the objective's value divided by `objective_scale`,
    clipped to [0, 1]. The rewards of an episode add up to Φ(end) - Φ(root). Where the objective could not score the
    child, Φ is that of the parent, the reward is 0 and `info["reward_valid"]` is 0.

    ## Starting State

    A sample of the prior, from a seed that `self.np_random` draws. `reset(options={"state": state})` starts from a
    given `MaskChoiceState` instead, and `options={"scene": batch}` from a given scene.

    ## Episode End

    `terminated` when nothing is left to improve: no mask has a slot, or Φ is 1. `truncated` at depth `max_depth`, or
    when `max_nfe` denoiser evaluations are spent since the reset.

    ## Arguments

    ```python
    import gymnasium as gym

    masks = ["culprits", "infeasible_or_empty", {"name": "empty", "count": 4}]
    env = gym.make("scene_envs:SceneEnvs/SearchMask-v0", scene="dimsum_table", masks=masks, branching=4)
    ```

    | argument | default | meaning |
    |---|---|---|
    | `masks` | `('culprits', 'infeasible', 'empty', 'infeasible_or_empty')` | the K [masks](../search.md#masks): names, mappings with settings, functions |
    | `scene` | `"dimsum_table"` | scene type |
    | `objective` | `"feasible_objects"` | any reward: name, mapping, function or object |
    | `branching` | `4` | inpaintings of each mask to choose from |
    | `max_depth` | `10` | actions per episode |
    | `num_steps` | `50` | denoising steps per inpainting |
    | `prior` | `None` | name, path or prior; `None` is the shipped prior of the scene type |
    | `slots` | `None` | slots per scene; `None` is the scene type's number, more is allowed |
    | `objective_scale` | `None` | objective at which Φ = 1; `None` is the largest it declares, else the free slots |
    | `max_nfe` | `None` | denoiser evaluations per episode; `None` is any number |
    | `workers` | `0` | processes for physics in the objective; 0 computes in this one |
    | `render_mode` | `None` | `"rgb_array"` renders the current scene |
    | `prompt` | `None` | what all scenes should hold, for priors that read prompts; the objective sees it too |
    | `guidance` | `0.0` | weight of classifier-free guidance, which doubles the NFE; needs a prompt |

    ## Vectorized environment

    `gym.make_vec("scene_envs:SceneEnvs/SearchMask-v0", num_envs=4, ...)` runs copies one after another. A planner is
    better served by `expand_batch`, which denoises many children in one batch.

    ## Version History

    * v0: initial version.
    """  # noqa: E501  (rows of a table)

    problem: MaskChoiceProblem

    @takes(SearchMaskSettings)
    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        problem = MaskChoiceProblem(**settings)
        self._begin(problem, render_mode, spaces.MultiBinary((len(problem.mask_names), problem.slots)))

    def _child(self, state: SearchState, action: int) -> SearchState:
        is_action = isinstance(action, int | np.integer) and 0 <= action < self.problem.num_actions
        if is_action and not bool(self.problem.mask_of(state, action).any()):
            return replace(state, depth=state.depth + 1, path=(*state.path, int(action)))
        return super()._child(state, action)

    def _check_state(self, state: Any) -> SearchState:
        checked, masks = super()._check_state(state), self.problem.mask_names
        if len(self.problem.masks_of(checked)) != len(masks):
            raise InvalidInputError(
                f"the state has {len(self.problem.masks_of(checked))} masks, this environment {len(masks)}: {masks}"
            )
        return checked

    def _observe(self, state: SearchState) -> tuple[Observation, dict[str, Any]]:
        observation, info = super()._observe(state)
        return {**observation, "regenerate": self.problem.masks_of(state).numpy().astype(np.int8)}, info
