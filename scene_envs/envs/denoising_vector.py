"""Batched Gymnasium adapter of the denoising MDP: a vector environment with every autoreset mode."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from scene_envs.envs.denoising import DenoisingCore
from scene_envs.envs.denoising_gymnasium import Observation, denoising_observation_space
from scene_envs.envs.settings import DenoisingSettings, takes
from scene_envs.envs.spaces import check_render_mode, check_reset_mask, picture, scene_box
from scene_envs.envs.specs import SpecMixin
from scene_envs.envs.trajectories import BoolArray, StepResult
from scene_envs.errors import InvalidInputError, unknown_name


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
