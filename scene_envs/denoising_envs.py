"""Gymnasium faces of the denoising MDP: one environment, and a batched vector environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from scene_envs.denoising import BoolArray, DenoisingCore, StepResult
from scene_envs.env_spaces import STATE_BOUND, check_action, check_render_mode, check_reset_mask, picture, scene_box
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene_types import SceneType

Observation = dict[str, np.ndarray]


def denoising_observation_space(core: DenoisingCore) -> spaces.Dict:
    """What one environment shows: ``scene``, ``timestep``, ``object_mask``, and ``prompt`` if there can be one."""
    observed: dict[str, spaces.Space[Any]] = {
        "scene": scene_box(STATE_BOUND, core.slots, core.features),
        "timestep": spaces.Box(0, core.first_timestep, (1,), np.int64),
        "object_mask": spaces.MultiBinary(core.slots),
    }
    if core.prompting.space is not None:
        length, words = core.prompting.space
        observed["prompt"] = spaces.Box(0, words - 1, (length,), np.int64)
    return spaces.Dict(observed)


class DenoisingEnv(gym.Env[Any, np.ndarray]):
    """The denoising process of a scene prior as an environment.

    ## Description

    A scene starts as Gaussian noise and becomes clean in `num_steps` steps; then a reward scores it, once. An
    agent that acts well makes scenes that the reward likes. This is the Markov decision process of DDPO (Black et
    al. 2024, Section 4.2) on scenes of objects with full SE(3) poses: the state is `(x_t, t)`, the action is
    `x_{t-1}`, and the transition is the identity. The reverse process itself belongs to the agent, except in
    `action_mode="noise"`, where the prior takes the reverse step and the agent chooses the noise of that step.

    Scenes are normalised tensors of N slots by D features: translation | rotation matrix | one-hot over C assets
    and *empty*. On `dimsum_table`, N = 34, C = 7, D = 20. A prior that diffuses quaternions or axis-angle vectors has
    these in place of the matrix, and D is smaller by 5 or 6.

    ## Action Space

    `Box(-max_action, max_action, (N, D), float32)`, `max_action` being 10.

    | `action_mode` | the action is | next scene |
    |---|---|---|
    | `"next_sample"` | x_{t-1}, normalised | the action |
    | `"noise"` | noise of the reverse step | mean(x_t, t) + std(t) * action, of the prior |

    In `noise` mode an action drawn from N(0, I) reproduces the prior, so stock agents begin at the prior's own
    behaviour. The last step has std 0: its action has no effect. Actions beyond the bound are clipped. A wrong
    shape, NaN or infinity raises `InvalidInputError`. Entries known to the prior (welded objects with one
    constant pose, features that never vary) are set to their values whatever the action says.

    ## Observation Space

    `Dict` of

    | key | space | meaning |
    |---|---|---|
    | `scene` | `Box(-10, 10, (N, D), float32)` | x_t, normalised |
    | `timestep` | `Box(0, T, (1,), int64)` | diffusion timestep t, 0 when the scene is finished |
    | `object_mask` | `MultiBinary(N)` | slots whose arg-max category is not *empty* |
    | `prompt` | `Box(0, V-1, (L,), int64)` | tokens of the prompt, 0 being padding; only if the prior reads prompts |

    `info` holds the same numbers at every reset and step: `step` (steps taken), `timestep`, `objects` (slots that
    are not empty, welded ones included), `reward_valid` (0 or 1), and `term_<name>` for each term of the reward
    (0 before the last step).

    ## Rewards

    0 at every step but the last, where it is the reward's value of the decoded scene. If the reward could not
    score that scene, the step gives 0.0 with `info["reward_valid"] = 0`: leave such episodes out of statistics.

    ## Starting State

    x_T: standard normal noise from `self.np_random`, known entries set; and a prompt, drawn from it too if `prompt`
    leaves a choice. The same seed gives the same x_T and the same prompt. In `noise` mode the prior follows the
    prompt; in `next_sample` mode the agent does what it likes with it. Rewards see it in their context.

    ## Episode End

    `terminated` after exactly `num_steps` steps, at t = 0. Never `truncated`.

    ## Arguments

    ```python
    import gymnasium as gym

    env = gym.make("scene_envs:SceneEnvs/Denoising-v0", scene="dimsum_table", reward="object_count", num_steps=50)
    ```

    | argument | default | meaning |
    |---|---|---|
    | `scene` | `"dimsum_table"` | scene type |
    | `reward` | `"object_count"` | name, mapping with settings, function or reward object |
    | `num_steps` | `50` | denoising steps per episode |
    | `prior` | `None` | name, path or prior; `None` is the shipped prior of the scene type |
    | `slots` | `None` | slots per scene; `None` is the scene type's number, more is allowed |
    | `action_mode` | `"next_sample"` | or `"noise"` |
    | `max_action` | `10.0` | bound of the action space |
    | `workers` | `0` | processes for physics in the reward; 0 computes in this one |
    | `render_mode` | `None` | `"rgb_array"` renders the decoded current scene |
    | `prompt` | `None` | one prompt, a list to draw from, or `"grammar"` for descriptions of the grammar's scenes |
    | `guidance` | `0.0` | weight of classifier-free guidance in `noise` mode; needs a prompt |

    ## Vectorized environment

    `gym.make_vec("scene_envs:SceneEnvs/Denoising-v0", num_envs=128, ...)` builds one batched environment
    (`DenoisingVectorEnv`): tensors inside, NumPy arrays outside. `autoreset_mode` is `"SameStep"` by default;
    `"NextStep"` and `"Disabled"` (with `options={"reset_mask": ...}`) are there too. Environment i of a vector
    environment seeded with s plays the episodes of a single environment seeded with s + i.
    `scene_envs.denoising_torchrl.DenoisingTorchRLEnv` is the torchrl face; it agrees bit for bit.

    ## Version History

    * v0: initial version.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  (declared so by gym.Env)

    def __init__(
        self,
        scene: str | SceneType = "dimsum_table",
        reward: Any = "object_count",
        num_steps: int = 50,
        prior: Any = None,
        slots: int | None = None,
        action_mode: str = "next_sample",
        max_action: float = 10.0,
        workers: int = 0,
        render_mode: str | None = None,
        prompt: Any = None,
        guidance: float = 0.0,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.core = DenoisingCore(
            1,
            scene=scene,
            reward=reward,
            num_steps=num_steps,
            prior=prior,
            slots=slots,
            action_mode=action_mode,
            max_action=max_action,
            workers=workers,
            prompt=prompt,
            guidance=guidance,
        )
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


class DenoisingVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """B denoising environments as one batch; the page of the environment is :class:`DenoisingEnv`.

    Args:
        num_envs: B.
        scene, reward, num_steps, prior, slots, action_mode, max_action, workers, render_mode, prompt, guidance: as for
            :class:`DenoisingEnv`.
        autoreset_mode: ``"SameStep"``, ``"NextStep"`` or ``"Disabled"``, or the Gymnasium enum.

    ``info`` values are (B,) arrays, each with its ``_key`` mask. In ``SameStep`` mode the step that ends an
    episode also gives ``final_obs`` ((B,) objects, each the dict of one environment) and ``final_info``.

    >>> from agents.priors.testing import tiny_prior
    >>> env = DenoisingVectorEnv(3, prior=tiny_prior(), num_steps=1)
    >>> observation, info = env.reset(seed=0)
    >>> observation["scene"].shape, info["timestep"].tolist()
    ((3, 34, 20), [1000, 1000, 1000])
    >>> env.step(observation["scene"])[2].tolist()
    [True, True, True]
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        scene: str | SceneType = "dimsum_table",
        reward: Any = "object_count",
        num_steps: int = 50,
        prior: Any = None,
        slots: int | None = None,
        action_mode: str = "next_sample",
        max_action: float = 10.0,
        workers: int = 0,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        prompt: Any = None,
        guidance: float = 0.0,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.autoreset_mode = _check_autoreset_mode(autoreset_mode)
        self.core = DenoisingCore(
            num_envs,
            scene=scene,
            reward=reward,
            num_steps=num_steps,
            prior=prior,
            slots=slots,
            action_mode=action_mode,
            max_action=max_action,
            workers=workers,
            prompt=prompt,
            guidance=guidance,
        )
        self.num_envs = num_envs
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = denoising_observation_space(self.core)
        self.single_action_space = scene_box(self.core.max_action, self.core.slots, self.core.features)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs = [seeding.np_random() for _ in range(num_envs)]
        self._pending: BoolArray = np.zeros(num_envs, np.bool_)  # NEXT_STEP: episodes to restart at the next step

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """One generator per environment."""
        return tuple(rng for rng, _ in self._rngs)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each generator."""
        return tuple(seed for _, seed in self._rngs)

    def reset(  # type: ignore[override]
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: environment i gets ``seed + i``, or ``seed[i]`` from a list; None continues the generators.
            options: ``{"reset_mask": (B,) bool}`` restarts only some environments.
        """
        mask = check_reset_mask(options, self.num_envs)
        seeds = _spread_seed(seed, self.num_envs)
        for index in np.flatnonzero(mask):
            if seeds[index] is not None:
                self._rngs[index] = seeding.np_random(seeds[index])
        self._pending[mask] = False
        self.core.reset(self.np_random, mask)
        observation, info = self._observe(None)
        return observation, _with_masks(info, mask)

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One denoising step in every environment; ``actions`` is (B, N, D).

        Raises:
            InvalidInputError: wrong shape, or a value that is not finite.
            ResetNeededError: in ``Disabled`` mode, an episode that ended was not reset.
        """
        result = self.core.step(actions, ~self._pending)
        if self._pending.any():
            self.core.reset(self.np_random, self._pending)
        everyone = np.ones(self.num_envs, np.bool_)
        observation, numbers = self._observe(result)
        info = _with_masks(numbers, everyone)
        ended = result.terminated
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._pending = ended.copy()
        elif self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            final = {
                "final_obs": _split(observation, ended),
                "_final_obs": ended.copy(),
                "final_info": _with_masks(numbers, ended),
                "_final_info": ended.copy(),
            }
            self.core.reset(self.np_random, ended)
            observation, numbers = self._observe(None)
            info = {**_with_masks(numbers, everyone), **final}
        reward = result.reward.cpu().numpy().astype(np.float64)
        return observation, reward, ended.copy(), np.zeros(self.num_envs, np.bool_), info

    def _observe(self, result: StepResult | None) -> tuple[Observation, dict[str, np.ndarray]]:
        observation = {key: value.cpu().numpy() for key, value in self.core.observation().items()}
        return observation, self.core.info(result)

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """One (H, W, 3) uint8 picture per environment, or None without a render mode."""
        return tuple(picture(self.core.scenes())) if self.render_mode else None

    def close_extras(self, **kwargs: Any) -> None:
        """Stop physics workers, if any."""
        self.core.close()


def _check_autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    known = {m.value: m for m in AutoresetMode}
    if mode not in known:
        raise unknown_name("autoreset mode", str(mode), known)
    return known[mode]


def _spread_seed(seed: int | list[int | None] | None, count: int) -> list[int | None]:
    if seed is None:
        return [None] * count
    if isinstance(seed, (int, np.integer)):
        return [int(seed) + i for i in range(count)]
    if len(seed) != count:
        raise InvalidInputError(f"{len(seed)} seeds for {count} environments; give one each, or a single number")
    return list(seed)


def _with_masks(info: dict[str, np.ndarray], mask: BoolArray) -> dict[str, Any]:
    """Gymnasium's vector info: each (B,) array (0 outside ``mask``) with its ``_key`` mask."""
    masked: dict[str, Any] = {}
    for key, value in info.items():
        masked[key] = np.where(mask, value, np.zeros_like(value))
        masked[f"_{key}"] = mask.copy()
    return masked


def _split(observation: Observation, mask: BoolArray) -> np.ndarray:
    """(B,) array of objects: the observation dict of each environment in ``mask``, None elsewhere."""
    split = np.full(len(mask), None, dtype=object)
    for index in np.flatnonzero(mask):
        split[index] = {key: value[index].copy() for key, value in observation.items()}
    return split
