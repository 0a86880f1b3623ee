"""Facts of scenes for rewards: sizes, boxes, masses, volumes, assets by name, supports."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from scene_envs.scene_types import SceneType

if TYPE_CHECKING:
    from scene_envs.assets.base import AssetLibrary

_CHUNK = 32
"""Number of scenes whose supports are found together."""


class AssetFacts(ABC):
    """The properties of :class:`~scene_envs.scene.SceneBatch` that depend on the assets themselves.

    All tensors are on the device of the scenes, and 0 or False in empty slots unless stated otherwise. The asset
    library is built on first use, which raises UnknownNameError for a scene type without models.
    """

    scene_type: SceneType

    @property
    @abstractmethod
    def translations(self) -> Tensor:
        """(B, N, 3) m, world frame."""

    @property
    @abstractmethod
    def rotations(self) -> Tensor:
        """(B, N, 3, 3), asset frame to world frame."""

    @property
    @abstractmethod
    def categories(self) -> Tensor:
        """(B, N) int64."""

    @property
    def masses(self) -> Tensor:
        """(B, N) kg; 0 for static assets.

        >>> from scene_envs import SceneBatch
        >>> SceneBatch.empty("dimsum_table", 1, slots=2).masses
        tensor([[0., 0.]])
        """
        return self._of_category(_measures(self.scene_type.library)[0])

    @property
    def volumes(self) -> Tensor:
        """(B, N) m^3 of material: the sum of the volumes of an object's convex parts; hollows are not counted.

        >>> from scene_envs import SceneBatch
        >>> SceneBatch.empty("dimsum_table", 1, slots=2).volumes.round(decimals=2)
        tensor([[0.0400, 0.0000]])
        """
        return self._of_category(_measures(self.scene_type.library)[1])

    @property
    def sizes(self) -> Tensor:
        """(B, N, 3) m: extents of each object's own box, along the axes of its asset frame.

        >>> from scene_envs import SceneBatch
        >>> SceneBatch.empty("dimsum_table", 1, slots=2).sizes
        tensor([[[1.2500, 1.2500, 0.7850],
                 [0.0000, 0.0000, 0.0000]]])
        """
        return self._of_category(_measures(self.scene_type.library)[2])

    @property
    def bounding_boxes(self) -> Tensor:
        """(B, N, 2, 3) m, world frame: lowest and highest corner of each object's convex parts at its pose.

        >>> from scene_envs import SceneBatch
        >>> SceneBatch.empty("dimsum_table", 1, slots=1).bounding_boxes
        tensor([[[[-0.6250, -0.6250, -0.7850],
                  [ 0.6250,  0.6250,  0.0000]]]])
        """
        categories, device = self.categories, self.translations.device
        boxes = torch.zeros(*categories.shape, 2, 3, dtype=torch.float64, device=device)
        for category, corners in enumerate(hull_corners(self.scene_type.library)):
            here = categories == category
            if not bool(here.any()):
                continue
            points = self.rotations[here].double() @ corners.T.to(device)  # (n, 3, V)
            low, high = points.amin(dim=-1), points.amax(dim=-1)
            boxes[here] = torch.stack([low, high], dim=1) + self.translations[here].double().unsqueeze(1)
        return boxes.float() + 0.0

    @property
    def supports(self) -> Tensor:
        """(B, N) int64: slot of the support or container of each object; -1 for none, fixed objects and empty slots.

        Two surfaces touch when they are at most 1 cm apart or at most 1 cm into each other. These are the
        supports that prompts describe (:func:`scene_envs.datasets.scene_facts`).

        >>> from scene_envs import SceneBatch
        >>> SceneBatch.empty("dimsum_table", 1, slots=2).supports
        tensor([[-1, -1]])
        """
        from scene_envs.supports import Contacts, Placed

        supports = torch.full(self.categories.shape, -1, dtype=torch.int64)
        for start in range(0, len(supports), _CHUNK):
            rows = slice(start, start + _CHUNK)
            shapes, placed, slot = Placed.of_scenes(
                self.scene_type,
                self.categories[rows].cpu().numpy(),
                self.translations[rows].double().cpu().numpy(),
                self.rotations[rows].double().cpu().numpy(),
            )
            below = Contacts.of(shapes, placed).holding().support
            held = below >= 0
            supports[rows][placed.scene[held], slot[held]] = torch.from_numpy(slot[below[held]])
        return supports.to(self.translations.device)

    def is_any_of(self, *names: str) -> Tensor:
        """(B, N) bool: slots that hold one of the named assets.

        Args:
            *names: Asset names, display names ("steamer lid") or groups such as ``"edible"``
                (:data:`scene_envs.assets.ASSET_GROUPS`).

        Raises:
            UnknownNameError: a name is none of these; the nearest known one is offered.

        >>> from scene_envs import SceneBatch
        >>> SceneBatch.empty("dimsum_table", 1, slots=2).is_any_of("furniture")
        tensor([[ True, False]])
        """
        from scene_envs.assets.groups import categories_of

        wanted = torch.tensor(categories_of(names, self.scene_type.library), dtype=torch.int64)
        return torch.isin(self.categories, wanted.to(self.categories.device))

    def _of_category(self, table: Tensor) -> Tensor:
        """(B, N, ...) rows of a table (C + 1, ...)."""
        return table.to(self.categories.device)[self.categories]


@lru_cache(maxsize=32)
def _measures(library: AssetLibrary) -> tuple[Tensor, Tensor, Tensor]:
    """Masses (C + 1,) kg, volumes (C + 1,) m^3 and sizes (C + 1, 3) m by category, empty last."""
    from scene_envs.assets.shapes import volume

    masses = [*(asset.mass for asset in library), 0.0]
    volumes = [*(volume(asset.fine) for asset in library), 0.0]
    sizes = [*((asset.bounds[1] - asset.bounds[0]).tolist() for asset in library), [0.0, 0.0, 0.0]]
    return torch.tensor(masses), torch.tensor(volumes), torch.tensor(sizes)


@lru_cache(maxsize=32)
def hull_corners(library: AssetLibrary) -> tuple[Tensor, ...]:
    """Corners (V, 3) of each asset's convex hull, m, float64."""
    from scene_envs.assets.shapes import hull_of

    return tuple(torch.from_numpy(hull_of(asset.fine).vertices) for asset in library)
