"""Spaces of the environments, and checks of user input against them."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import gymnasium.error
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from torch import Tensor

from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import InvalidInputError, SceneEnvsError
from scene_envs.protocols import PriorLike
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

DEFAULT_SCENE = "dimsum_table"
STATE_BOUND = 10.0
"""Normalised scenes are kept within ±10. Data lies in [-1, 1] and no float32 normal draw exceeds 6.8."""


def resolve_scene_and_prior(
    scene: str | SceneType | None, prior: Any, device: str = "auto"
) -> tuple[SceneType, PriorLike]:
    """The scene type, and its prior on ``device``: the given one, or the shipped one of the scene type's name. Without
    a scene type, that of the prior is taken; without both, ``dimsum_table``.
    """
    if scene is None and prior is None:
        scene = DEFAULT_SCENE
    named = None if scene is None else get_scene_type(scene)
    resolved = resolve_prior(named.name if prior is None and named is not None else prior, device)
    if not isinstance(resolved, PriorLike):
        raise InvalidInputError(f"prior={prior!r} is not a prior; give a name, a path or a prior object")
    scene_type = resolved.scene_type if named is None else named
    if resolved.scene_type.name != scene_type.name:
        raise InvalidInputError(
            f"the prior makes scenes of {resolved.scene_type.name!r}, the environment asks for {scene_type.name!r}; "
            f"pass scene={resolved.scene_type.name!r} or another prior"
        )
    return scene_type, resolved


def check_slots(scene_type: SceneType, slots: int | None) -> int:
    """The number of slots per scene, defaulting to the scene type's."""
    if slots is None:
        return scene_type.slots
    smallest = len(scene_type.fixed) + 1
    if not isinstance(slots, int) or slots < smallest:
        raise InvalidInputError(f"slots={slots!r}: scenes of {scene_type.name!r} need at least {smallest} slots")
    return slots


def scene_box(bound: float, slots: int, features: int) -> spaces.Box:
    """Box(-bound, bound, (N, D), float32)."""
    return spaces.Box(-bound, bound, (slots, features), np.float32)


def occupied(x: Tensor, scene_type: SceneType) -> Tensor:
    """(B, N) int8: 1 where the arg-max category of normalised or raw scenes (B, N, D) is not *empty*. Slots whose
    category is not drawn yet (rows of zeros, from a mixed prior) count as empty.
    """
    category = x[..., -(scene_type.num_assets + 1) :]
    drawn = (category != 0).any(dim=-1)
    return (drawn & (category.argmax(dim=-1) != category.shape[-1] - 1)).to(torch.int8)


def check_action(action: Any, shape: tuple[int, ...], axes: tuple[str, ...]) -> Tensor:
    """``action``, anything array-like, as a finite tensor of ``shape`` and of torch's default dtype, float32 unless a
    program changes it. Raises InvalidInputError for another shape (``axes`` names its dimensions) or a value that is
    not finite.
    """
    try:
        tensor = action if isinstance(action, Tensor) else torch.from_numpy(np.asarray(action, dtype=np.float32))
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"the action is not an array of numbers of shape {shape}: {error}") from error
    tensor = tensor.detach().to(torch.get_default_dtype())
    if tuple(tensor.shape) != shape:
        raise InvalidInputError(
            f"the action has shape {tuple(tensor.shape)}, it must be {shape}, that is ({', '.join(axes)})"
        )
    finite = torch.isfinite(tensor)
    if not bool(finite.all()):
        index = torch.nonzero(~finite)[0].tolist()
        place = ", ".join(f"{axis} {i}" for axis, i in zip(axes, index, strict=True))
        raise InvalidInputError(f"the action holds {tensor[tuple(index)].item()} at {place}; all values must be finite")
    return tensor


def check_render_mode(render_mode: str | None) -> str | None:
    """``None`` or ``"rgb_array"``."""
    if render_mode not in (None, "rgb_array"):
        raise InvalidInputError(f"render_mode={render_mode!r} is not supported; use 'rgb_array' or None")
    return render_mode


def check_reset_mask(options: dict[str, Any] | None, count: int) -> np.ndarray:
    """The (B,) bool ``reset_mask`` of Gymnasium's vector reset options; all True when it is not given."""
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return np.ones(count, np.bool_)
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (count,) or not mask.any():
        raise InvalidInputError(
            f"options['reset_mask'] must be a bool array of shape ({count},) with at least one True, got {mask!r}"
        )
    return mask


def picture(batch: SceneBatch, highlight: Tensor | None = None) -> np.ndarray:
    """(B, H, W, 3) uint8 pictures, with the objects of ``highlight`` (B, N) bool in red (loads the renderer)."""
    from scene_envs.render import render

    return render(batch.to("cpu"), highlight=highlight)


class ResetNeededError(SceneEnvsError, gymnasium.error.ResetNeeded):
    """``step`` was called before ``reset``, or after the end of an episode."""


class SceneEnvSpec(EnvSpec):
    """A spec whose ``to_json`` names the keyword argument that cannot be written as JSON."""

    def to_json(self) -> str:
        """The spec as JSON; InvalidInputError for a function or an object: give its name instead."""
        for name, value in self.kwargs.items():
            try:
                json.dumps(value)
            except TypeError as error:
                raise InvalidInputError(
                    f"the spec cannot be written as JSON: {name}={value!r} is no text, number or list; register it, "
                    f"and give its name as {name}="
                ) from error
        return super().to_json()


class SpecMixin:
    """Mixin of environments that turns the ``spec`` set by Gymnasium into a :class:`SceneEnvSpec`."""

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The environment's spec, with the keyword arguments of ``gym.make``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is None or isinstance(spec, SceneEnvSpec):
            self._spec = spec
            return
        fields: dict[str, Any] = {f.name: getattr(spec, f.name) for f in dataclasses.fields(spec) if f.init}
        self._spec = SceneEnvSpec(**fields)
