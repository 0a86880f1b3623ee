"""Adapters of the denoising MDP: a Gymnasium environment of one scene, one of a batch, and one for torchrl."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from scene_envs.envs.denoising import BoolArray, DenoisingCore, StepResult
from scene_envs.envs.settings import DenoisingSettings, takes
from scene_envs.envs.spaces import (
    STATE_BOUND,
    SpecMixin,
    check_action,
    check_render_mode,
    check_reset_mask,
    picture,
    scene_box,
)
from scene_envs.errors import InvalidInputError, unknown_name

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
    | `physics` | `"auto"` | engine of motion: `bullet`, `mujoco`, `warp`; `auto`: Bullet if installed, else MuJoCo |
    | `device` | `"auto"` | device of the network: `cpu`, `cuda`; `auto`: of a given prior, else the GPU if any |
    | `render_mode` | `None` | `"rgb_array"` renders the decoded current scene |
    | `prompt` | `None` | one prompt, a list to draw from, or `"grammar"` for descriptions of the grammar's scenes |
    | `guidance` | `0.0` | weight of classifier-free guidance in `noise` mode; needs a prompt |

    ## Vectorized environment

    `gym.make_vec("scene_envs:SceneEnvs/Denoising-v0", num_envs=128, ...)` builds one batched environment
    (`DenoisingVectorEnv`): tensors inside, NumPy arrays outside. `autoreset_mode` is `"SameStep"` by default;
    `"NextStep"` and `"Disabled"` (with `options={"reset_mask": ...}`) are available. Environment i of a vector
    environment seeded with s plays the same episodes as a single environment seeded with s + i.
    `scene_envs.envs.DenoisingTorchRLEnv` is the torchrl adapter; it agrees with `DenoisingVectorEnv` bit for bit.
    Post-training samples with its `rollout`, which gives a TensorDict [B, S] of whole episodes. `reset(prompts=[...])`
    takes one prompt per episode in place of drawn ones.

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


class DenoisingTorchRLEnv(EnvBase):
    """B denoising episodes as a batch-locked torchrl environment; :class:`DenoisingEnv` describes them.

    Keys: ``scene`` (B, N, D) float32, ``timestep`` (B, 1) int64, ``object_mask`` (B, N) int8, ``valid`` (B, 1) bool
    (False where the reward could not score the finished scene, whose reward is then 0), ``prompt`` (B, L) int64 if the
    prior reads prompts, ``action`` (B, N, D), ``reward``, ``terminated``, ``truncated`` and ``done`` (B, 1). Everything
    lives on the prior's device.

    With the same seed, ``reset`` and ``step`` give bit for bit what ``DenoisingVectorEnv`` gives, and
    ``rollout(S, policy)`` gives B whole episodes as a TensorDict [B, S]. ``reset(prompts=...)`` takes one prompt per
    episode in place of drawn ones.

    Args:
        num_envs: B.
        **settings: fields of :class:`~scene_envs.envs.settings.DenoisingSettings`.

    Attributes:
        result: everything about the last step, such as the score of the scenes that it finished; None after a reset.

    >>> env = DenoisingTorchRLEnv(2, reward="object_count", num_steps=3)
    >>> env.rollout(3)["next", "terminated"].squeeze(-1).tolist()
    [[False, False, True], [False, False, True]]
    """

    @takes(DenoisingSettings)
    def __init__(self, num_envs: int = 1, **settings: Any) -> None:
        core = DenoisingCore(num_envs, **settings)
        super().__init__(device=core.device, batch_size=torch.Size([num_envs]))
        self.core = core
        self.result: StepResult | None = None
        self._set_seed(None)
        batch, device = self.batch_size, self.device
        scene_shape = (*batch, core.slots, core.features)
        self.observation_spec = Composite(
            {
                "scene": Bounded(-STATE_BOUND, STATE_BOUND, scene_shape, device, torch.float32),
                "timestep": Bounded(0, core.first_timestep, (*batch, 1), device, torch.int64),
                "object_mask": Binary(core.slots, (*batch, core.slots), device, torch.int8),
                "valid": Binary(1, (*batch, 1), device, torch.bool),
            },
            shape=batch,
            device=device,
        )
        if core.prompting.space is not None:
            length, words = core.prompting.space
            self.observation_spec["prompt"] = Bounded(0, words - 1, (*batch, length), device, torch.int64)
        self.action_spec = Bounded(-core.max_action, core.max_action, scene_shape, device, torch.float32)
        self.reward_spec = Unbounded((*batch, 1), device, torch.float32)
        flag = Binary(1, (*batch, 1), device, torch.bool)
        self.done_spec = Composite(
            {"done": flag, "terminated": flag.clone(), "truncated": flag.clone()}, shape=batch, device=device
        )

    def _set_seed(self, seed: int | None) -> None:
        """Environment i gets the generator of ``seed + i``, as in the vector environment."""
        seeds = _spread_seed(None if seed is None else int(seed), self.core.num_envs)
        self._rngs = [seeding.np_random(own)[0] for own in seeds]

    def _reset(
        self, tensordict: TensorDictBase | None = None, prompts: Sequence[str] | None = None, **kwargs: Any
    ) -> TensorDictBase:
        flags = None if tensordict is None else tensordict.get("_reset", None)
        mask = None if flags is None else flags.reshape(self.core.num_envs).cpu().numpy()
        self.core.reset(self._rngs, mask, prompts)
        self.result = None
        return self._observe(None)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.result = self.core.step(tensordict["action"])
        observed = self._observe(self.result)
        observed["reward"] = self.result.reward.unsqueeze(-1)
        return observed

    def _observe(self, result: StepResult | None) -> TensorDict:
        finished = self.core.column(self.core.finished)
        valid = torch.ones_like(finished) if result is None else result.valid.unsqueeze(-1)
        fields = {
            **self.core.observation(),
            "valid": valid,
            "done": finished,
            "terminated": finished.clone(),
            "truncated": torch.zeros_like(finished),
        }
        return TensorDict(fields, batch_size=self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Stop physics workers, if any."""
        self.core.close()
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)


class DenoisingVectorEnv(SpecMixin, VectorEnv[Observation, np.ndarray, np.ndarray]):
    """B denoising environments as one batch; :class:`DenoisingEnv` describes the environment.

    Args:
        num_envs: B, the number of environments.
        render_mode: None or ``"rgb_array"``.
        autoreset_mode: ``"SameStep"``, ``"NextStep"`` or ``"Disabled"``, or the Gymnasium enum.
        **settings: Fields of :class:`~scene_envs.envs.settings.DenoisingSettings`.

    ``info`` values are (B,) arrays, each with its ``_key`` mask. In ``SameStep`` mode the step that ends an
    episode also gives ``final_obs`` ((B,) objects, each the dict of one environment) and ``final_info``.

    >>> env = DenoisingVectorEnv(3, num_steps=1)
    >>> observation, info = env.reset(seed=0)
    >>> observation["scene"].shape, info["timestep"].tolist()
    ((3, 34, 20), [1000, 1000, 1000])
    >>> env.step(observation["scene"])[2].tolist()
    [True, True, True]
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    @takes(DenoisingSettings)
    def __init__(
        self,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        **settings: Any,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.autoreset_mode = _check_autoreset_mode(autoreset_mode)
        self.core = DenoisingCore(num_envs, **settings)
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
            seed: Seed of environment i is ``seed + i``, or ``seed[i]`` of a list; None continues the generators.
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
            ResetNeededError: an episode that ended was not reset (``Disabled`` mode).
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
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise unknown_name("autoreset mode", str(mode), [known.value for known in AutoresetMode]) from None


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
