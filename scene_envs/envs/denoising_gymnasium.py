"""Gymnasium adapter of the denoising MDP: one environment, one scene."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from scene_envs.envs.denoising import DenoisingCore
from scene_envs.envs.settings import DenoisingSettings, takes
from scene_envs.envs.spaces import STATE_BOUND, check_action, check_render_mode, picture, scene_box
from scene_envs.envs.specs import SpecMixin
from scene_envs.envs.trajectories import StepResult

Observation = dict[str, np.ndarray]


def denoising_observation_space(core: DenoisingCore) -> spaces.Dict:
    """Observation space of one environment: ``scene``, ``timestep``, ``object_mask``, and ``prompt`` if it has any."""
    observed: dict[str, spaces.Space[Any]] = {
        "scene": scene_box(STATE_BOUND, core.slots, core.features),
        "timestep": spaces.Box(0, core.first_timestep, (1,), np.int64),
        "object_mask": spaces.MultiBinary(core.slots),
    }
    if core.prompting.space is not None:
        length, words = core.prompting.space
        observed["prompt"] = spaces.Box(0, words - 1, (length,), np.int64)
    return spaces.Dict(observed)


class DenoisingEnv(SpecMixin, gym.Env[Any, np.ndarray]):
    """The denoising process of a scene prior as an environment.

    ## Description

    A scene starts as Gaussian noise and is denoised in `num_steps` steps. A reward then scores the clean scene. The
    agent's goal is a scene with a high reward. The environment is the Markov decision process of DDPO (Black et al.
    2024, Section 4.2) on scenes of objects with full SE(3) poses: the state is `(x_t, t)`, the action is `x_{t-1}`, and
    the transition is the identity, so the action is the next scene. The reverse process belongs to the agent, except in
    `action_mode="noise"`: there the prior takes the reverse step, and the agent chooses the noise of that step.

    Scenes are normalised tensors of N slots by D features: translation | rotation matrix | one-hot over C assets and
    *empty*. On `dimsum_table`, N = 34, C = 7, D = 20. Priors that diffuse quaternions or axis-angle vectors use these
    in place of the matrix; D is then smaller by 5 or 6.

    ## Action Space

    `Box(-max_action, max_action, (N, D), float32)`; `max_action` is 10 by default.

    | `action_mode` | the action is | next scene |
    |---|---|---|
    | `"next_sample"` | x_{t-1}, normalised | the action |
    | `"noise"` | noise of the reverse step | mean(x_t, t) + std(t) * action, of the prior |

    In `noise` mode an action drawn from N(0, I) reproduces the prior, so standard agents start from the prior's own
    behaviour. The last step has std 0, so its action has no effect. Actions beyond the bound are clipped. A wrong
    shape, NaN or infinity raises `InvalidInputError`. Entries that the prior knows (welded objects with one constant
    pose, features that never vary) keep their values under every action.

    ## Observation Space

    A `Dict` with the keys

    | key | space | meaning |
    |---|---|---|
    | `scene` | `Box(-10, 10, (N, D), float32)` | x_t, normalised |
    | `timestep` | `Box(0, T, (1,), int64)` | diffusion timestep t, 0 when the scene is finished |
    | `object_mask` | `MultiBinary(N)` | slots whose category is drawn and is an asset (arg-max), not *empty* |
    | `prompt` | `Box(0, V-1, (L,), int64)` | tokens of the prompt, padded with 0; only if the prior reads prompts |

    `info` holds the same numbers at every reset and step: `step` (steps taken), `timestep`, `objects` (slots that
    are not empty, welded ones included), `reward_valid` (0 or 1), and `term_<name>` for each term of the reward
    (0 before the last step).

    ## Rewards

    The reward is 0 at every step except the last. There it is the value of `reward` for the decoded scene. If `reward`
    cannot score that scene, the step returns 0.0 with `info["reward_valid"] = 0`; leave such episodes out of
    statistics.

    ## Starting State

    The first scene, x_T, is standard normal noise from `self.np_random`, with known entries set. If `prompt` leaves a
    choice, `self.np_random` draws the prompt, too. The same seed gives the same x_T and the same prompt. In `noise`
    mode the prior is conditioned on the prompt; in `next_sample` mode the agent may use or ignore the prompt. Rewards
    get the prompt in their context.

    ## Episode End

    The episode is `terminated` after exactly `num_steps` steps, at t = 0. It is never `truncated`.

    ## Arguments

    ```python
    import gymnasium as gym

    env = gym.make("scene_envs:SceneEnvs/Denoising-v0", scene="dimsum_table", reward="object_count", num_steps=50)
    ```

    | argument | default | meaning |
    |---|---|---|
    | `scene` | `None` | scene type; `None` is that of the prior, `"dimsum_table"` without one |
    | `reward` | `"object_count"` | name, mapping with settings, function or reward object |
    | `num_steps` | `50` | denoising steps per episode |
    | `prior` | `None` | name, path or prior; `None` is the shipped prior of the scene type |
    | `slots` | `None` | slots per scene; `None` is the scene type's number, more is allowed |
    | `action_mode` | `"next_sample"` | or `"noise"` |
    | `max_action` | `10.0` | bound of the action space |
    | `workers` | `0` | processes for physics in the reward; 0: in the calling process; `"ray"`: on a Ray cluster |
    | `render_mode` | `None` | `"rgb_array"` renders the decoded current scene |
    | `prompt` | `None` | one prompt, a list to draw from, or `"grammar"` for descriptions of the grammar's scenes |
    | `guidance` | `0.0` | weight of classifier-free guidance in `noise` mode; needs a prompt |

    ## Vectorized environment

    `gym.make_vec("scene_envs:SceneEnvs/Denoising-v0", num_envs=128, ...)` builds one batched environment
    (`DenoisingVectorEnv`): tensors inside, NumPy arrays outside. `autoreset_mode` is `"SameStep"` by default;
    `"NextStep"` and `"Disabled"` (with `options={"reset_mask": ...}`) are available. Environment i of a vector
    environment seeded with s plays the same episodes as a single environment seeded with s + i.
    `scene_envs.envs.DenoisingTorchRLEnv` is the torchrl adapter; it agrees with `DenoisingVectorEnv` bit for bit.

    ## Version History

    * v0: initial version.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  (declared so by gym.Env)

    @takes(DenoisingSettings)
    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.core = DenoisingCore(1, **settings)
        self.observation_space = denoising_observation_space(self.core)
        self.action_space = scene_box(self.core.max_action, self.core.slots, self.core.features)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw x_T; see the class for observation and info. No options are read."""
        super().reset(seed=seed)
        self.core.reset([self.np_random])
        return self._observe(None)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One denoising step; ``action`` is (N, D).

        Raises:
            InvalidInputError: wrong shape, or a value that is not finite.
            ResetNeededError: the episode has ended.
        """
        checked = check_action(action, (self.core.slots, self.core.features), ("slot", "feature"))
        result = self.core.step(checked.unsqueeze(0))
        observation, info = self._observe(result)
        return observation, float(result.reward[0]), bool(result.terminated[0]), False, info

    def _observe(self, result: StepResult | None) -> tuple[Observation, dict[str, Any]]:
        observation = {key: value[0].cpu().numpy() for key, value in self.core.observation().items()}
        return observation, {key: value[0].item() for key, value in self.core.info(result).items()}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(H, W, 3) uint8 picture of the decoded current scene, or None without a render mode."""
        return picture(self.core.scenes())[0] if self.render_mode else None

    def close(self) -> None:
        """Stop physics workers, if any."""
        self.core.close()
