"""Specs of environments, with a clear error where a keyword argument cannot be written as JSON."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from gymnasium.envs.registration import EnvSpec

from scene_envs.errors import InvalidInputError


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
