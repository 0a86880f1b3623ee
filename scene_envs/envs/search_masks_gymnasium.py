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

    A `Dict` with the keys

    | key | space | meaning |
    |---|---|---|
    | `scene` | `Box(-10, 10, (N, D), float32)` | the scene, normalised |
    | `object_mask` | `MultiBinary(N)` | slots that are not *empty* |
    | `regenerate` | `MultiBinary((K, N))` | slots that each mask regenerates |
    | `depth` | `Box(0, max_depth, (1,), int64)` | actions taken |
    | `value` | `Box(0, 1, (1,), float32)` | Φ of the scene, see Rewards |
    | `prompt` | `Box(0, V-1, (L,), int64)` | tokens of the prompt, padded with 0; only if `prompt=` is given |

    `info` has the same keys as in `Search-v0`; `regenerate` is the number of slots that are in any mask.

    ## Rewards

    The reward is Φ(s') - Φ(s). Φ is the objective's value divided by `objective_scale`, clipped to [0, 1]. The
    rewards of an episode add up to Φ(end) - Φ(root). If the objective cannot score the child, the child takes the
    parent's Φ, so the reward is 0, and `info["reward_valid"]` is 0.

    ## Starting State

    An episode starts from a sample of the prior; `self.np_random` draws the sample's seed. `reset(options={"state":
    state})` starts from a given `MaskChoiceState` instead, and `options={"scene": batch}` from a given scene.

    ## Episode End

    The episode is `terminated` when nothing is left to improve: no mask has a slot, or Φ is 1. It is `truncated` at
    depth `max_depth`, or when `max_nfe` denoiser evaluations are spent since the reset.

    ## Arguments

    ```python
    import gymnasium as gym

    masks = ["culprits", "infeasible_or_empty", {"name": "empty", "count": 4}]
    env = gym.make("scene_envs:SceneEnvs/SearchMask-v0", scene="dimsum_table", masks=masks, branching=4)
    ```

    | argument | default | meaning |
    |---|---|---|
    | `masks` | `('culprits', 'infeasible', 'empty', 'infeasible_or_empty')` | the K [masks](../search.md#masks): names, mappings with settings, functions |
    | `scene` | `None` | scene type; `None` is that of the prior, `"dimsum_table"` without one |
    | `objective` | `"feasible_objects"` | any reward: name, mapping, function or object |
    | `branching` | `4` | inpaintings of each mask to choose from |
    | `max_depth` | `10` | actions per episode |
    | `num_steps` | `50` | denoising steps per inpainting |
    | `prior` | `None` | name, path or prior; `None` is the shipped prior of the scene type |
    | `slots` | `None` | slots per scene; `None` is the scene type's number, more is allowed |
    | `objective_scale` | `None` | objective at which Φ = 1; `None` is the largest it declares, else the free slots |
    | `max_nfe` | `None` | denoiser evaluations per episode; `None` is any number |
    | `workers` | `0` | processes for physics in the objective; 0: in the calling process; `"ray"`: on a Ray cluster |
    | `render_mode` | `None` | `"rgb_array"`: pictures, masked objects in red; `"human"`: a page in the browser |
    | `prompt` | `None` | text that all scenes should satisfy, for priors that read prompts; the objective gets it too |
    | `guidance` | `0.0` | weight of classifier-free guidance, which doubles the NFE; needs a prompt |
    | `claim_guidance` | `0.0` | strength of guidance to the numbers and places that the prompt gives; needs a prompt |
    | `physics_guidance` | `0.0` | strength with which objects are moved out of overlaps and onto supports, 0 to 1 |

    ## Vectorized environment

    `gym.make_vec("scene_envs:SceneEnvs/SearchMask-v0", num_envs=4, ...)` runs copies one after another. Planners should
    use `expand_batch`, which denoises many children in one batch.

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
