"""Settings of post-training inside inpainting; imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.configuration import require_one_of
from scene_envs.errors import InvalidInputError

SOURCES = ("real", "samples")
ENTRIES = ("slots", "poses")


@dataclass
class InpaintSettings:
    """Settings of post-training inside inpainting: a part of each scene is observed, and the rest is the action.

    Attributes:
        mask: mask generator that chooses the slots to regenerate: a registered name, or a mapping of its name and
            settings; null samples whole scenes.
        scenes: source of the observed slots: ``real`` for the real scenes of the regularisation, ``samples`` for fresh
            samples of the sampling policy.
        entries: entries of a masked slot that are regenerated: ``slots`` for pose and category, ``poses`` for the pose
            alone, while the category is observed.
    """

    mask: Any = None
    scenes: str = "real"
    entries: str = "slots"

    def __post_init__(self) -> None:
        named = isinstance(self.mask, Mapping) and isinstance(self.mask.get("name"), str)
        if not (self.mask is None or (isinstance(self.mask, str) and self.mask) or named):
            raise InvalidInputError(
                f"inpaint.mask={self.mask!r} must be the name of a mask generator, a mapping with its name and "
                "settings, or null; @register_mask gives a function a name"
            )
        require_one_of(self, "scenes", SOURCES)
        require_one_of(self, "entries", ENTRIES)
