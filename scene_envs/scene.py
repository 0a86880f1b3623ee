"""SceneBatch: a batch of scenes, the one data type that crosses module boundaries; and the distance between scenes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array, Index, constant_on
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError
from scene_envs.files import read_tensors, write_tensors
from scene_envs.normalizer import Normalizer
from scene_envs.rotations import project_to_so3
from scene_envs.scene_types import SceneType, get_scene_type

if TYPE_CHECKING:
    from scene_envs.assets.base import AssetLibrary

POSE_FEATURES = 12
"""Numbers of a pose: translation (3) and rotation matrix (9)."""
POSE = slice(0, POSE_FEATURES)
TRANSLATION = slice(0, 3)
ROTATION = slice(3, POSE_FEATURES)
CATEGORY = slice(POSE_FEATURES, None)
_CHUNK = 32
"""Number of scenes whose supports are found together."""
_ORTHOGONAL = 1e-3
"""Largest entry of R^T R - I of a rotation matrix R."""


class SceneBatch:
    """B scenes of N slots each, with their scene type.

    A slot is translation (m, world frame) | rotation matrix row-major | one-hot over C assets + empty last.
    Empty slots are zeros but for their last entry. The order of slots has no meaning.

    Tensors of properties are on the device of the scenes. Those that depend on the assets themselves (``masses``,
    ``volumes``, ``sizes``, ``bounding_boxes``, ``supports``, ``is_any_of``) are 0 or False in empty slots unless stated
    otherwise; the asset library is built on first use, which raises UnknownNameError for a scene type without models.

    Args:
        tensor: (B, N, 3 + 9 + C + 1) float32, raw (not normalised) and finite.
        scene_type: Scene type or its name.

    Raises:
        InvalidInputError: wrong shape, or a value that is not finite (its scene, slot and feature are named).

    >>> batch = SceneBatch.empty("dimsum_table", 2)
    >>> len(batch), batch.counts.tolist(), batch.names()[0][:1]
    (2, [1, 1], ['cafe_table'])
    """

    def __init__(self, tensor: Tensor, scene_type: str | SceneType) -> None:
        self.scene_type = get_scene_type(scene_type)
        _require_scene_tensor(tensor, self.scene_type)
        self._tensor = tensor.to(torch.float32)

    @classmethod
    def from_parts(
        cls, translations: Tensor, rotations: Tensor, categories: Tensor, scene_type: str | SceneType
    ) -> SceneBatch:
        """From translations (B, N, 3) m, rotations (B, N, 3, 3) and categories (B, N) int, C meaning empty."""
        scene_type = get_scene_type(scene_type)
        empty = scene_type.num_assets
        if categories.numel() and (int(categories.min()) < 0 or int(categories.max()) > empty):
            raise InvalidInputError(
                f"categories must lie in 0..{empty} for {scene_type.name!r} ({empty} is empty), "
                f"got {int(categories.min())}..{int(categories.max())}"
            )
        present = (categories != empty).unsqueeze(-1)
        one_hot = torch.nn.functional.one_hot(categories.long(), empty + 1).to(torch.float32)
        pose = torch.cat([translations.float(), rotations.float().flatten(-2)], dim=-1) * present
        return cls(torch.cat([pose, one_hot], dim=-1), scene_type)

    @classmethod
    def from_tensor(
        cls, tensor: Tensor, scene_type: str | SceneType, *, normalised: Normalizer | None = None
    ) -> SceneBatch:
        """From a (B, N, D) tensor such as a sampler's output.

        Rotations are projected to SO(3) by SVD and categories are the arg-max; empty slots get a pose of zeros.

        Args:
            tensor: (B, N, D) floats.
            scene_type: Scene type or its name.
            normalised: Normalizer that ``tensor`` was normalised with; None when it is raw.
        """
        scene_type = get_scene_type(scene_type)
        _require_scene_tensor(tensor, scene_type)
        categories = tensor[..., CATEGORY].argmax(dim=-1)
        raw = tensor.float() if normalised is None else normalised.unnormalize(tensor.float())
        rotations = project_to_so3(raw[..., ROTATION].unflatten(-1, (3, 3)))
        return cls.from_parts(raw[..., TRANSLATION], rotations, categories, scene_type)

    @classmethod
    def empty(cls, scene_type: str | SceneType, count: int, slots: int | None = None) -> SceneBatch:
        """``count`` scenes with the fixed welded objects alone."""
        scene_type = get_scene_type(scene_type)
        slots = scene_type.slots if slots is None else slots
        translations = torch.zeros(count, slots, 3)
        rotations = torch.eye(3).expand(count, slots, 3, 3).clone()
        categories = torch.full((count, slots), scene_type.num_assets)
        for slot, fixed in enumerate(scene_type.fixed):
            translations[:, slot] = torch.tensor(fixed.translation)
            rotations[:, slot] = torch.tensor(fixed.rotation).reshape(3, 3)
            categories[:, slot] = scene_type.assets.index(fixed.asset)
        return cls.from_parts(translations, rotations, categories, scene_type)

    @classmethod
    def concatenate(cls, batches: Sequence[SceneBatch]) -> SceneBatch:
        """One batch from several of the same scene type and number of slots."""
        if not batches:
            raise InvalidInputError("concatenate needs at least one SceneBatch, got none")
        names = {batch.scene_type.name for batch in batches}
        if len(names) > 1:
            raise InvalidInputError(f"cannot concatenate scenes of different types: {sorted(names)}")
        return cls(torch.cat([batch.tensor for batch in batches]), batches[0].scene_type)

    @property
    def tensor(self) -> Tensor:
        """(B, N, D) float32, raw."""
        return self._tensor

    @property
    def translations(self) -> Tensor:
        """(B, N, 3) m, world frame."""
        return self._tensor[..., TRANSLATION]

    @property
    def rotations(self) -> Tensor:
        """(B, N, 3, 3), asset frame to world frame; all zeros in empty slots."""
        return self._tensor[..., ROTATION].unflatten(-1, (3, 3))

    @property
    def categories(self) -> Tensor:
        """(B, N) int64; C means empty."""
        return self._tensor[..., CATEGORY].argmax(dim=-1)

    @property
    def is_empty(self) -> Tensor:
        """(B, N) bool."""
        return self.categories == self.scene_type.num_assets

    @property
    def is_welded(self) -> Tensor:
        """(B, N) bool: slots that hold welded assets."""
        from scene_envs.supports import welded_mask

        return constant_on(welded_mask(self.scene_type), self._tensor.device)[self.categories]

    @property
    def is_free(self) -> Tensor:
        """(B, N) bool: neither empty nor welded."""
        return ~(self.is_empty | self.is_welded)

    @property
    def is_furniture(self) -> Tensor:
        """(B, N) bool: welded objects that are generated, such as the tables of a room."""
        furniture = torch.tensor(self.scene_type.furniture_categories, device=self._tensor.device, dtype=torch.long)
        return torch.isin(self.categories, furniture)

    @property
    def counts(self) -> Tensor:
        """(B,) int64: objects per scene, welded ones included."""
        return (~self.is_empty).sum(dim=-1)

    @property
    def in_workspace(self) -> Tensor:
        """(B, N) bool: the object's frame lies in the workspace (False for empty slots)."""
        low, high = (torch.tensor(c, device=self._tensor.device) for c in self.scene_type.workspace)
        inside = ((self.translations >= low) & (self.translations <= high)).all(dim=-1)
        return inside & ~self.is_empty

    @property
    def masses(self) -> Tensor:
        """(B, N) kg; 0 for static assets.

        >>> SceneBatch.empty("dimsum_table", 1, slots=2).masses
        tensor([[0., 0.]])
        """
        return self._of_category(_measures(self.scene_type.library)[0])

    @property
    def volumes(self) -> Tensor:
        """(B, N) m^3 of material: the sum of the volumes of an object's convex parts; hollows are not counted.

        >>> SceneBatch.empty("dimsum_table", 1, slots=2).volumes.round(decimals=2)
        tensor([[0.0400, 0.0000]])
        """
        return self._of_category(_measures(self.scene_type.library)[1])

    @property
    def sizes(self) -> Tensor:
        """(B, N, 3) m: extents of each object's own box, along the axes of its asset frame.

        >>> SceneBatch.empty("dimsum_table", 1, slots=2).sizes
        tensor([[[1.2500, 1.2500, 0.7850],
                 [0.0000, 0.0000, 0.0000]]])
        """
        return self._of_category(_measures(self.scene_type.library)[2])

    @property
    def bounding_boxes(self) -> Tensor:
        """(B, N, 2, 3) m, world frame: lowest and highest corner of each object's convex parts at its pose.

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

        >>> SceneBatch.empty("dimsum_table", 1, slots=2).supports
        tensor([[-1, -1]])
        """
        from scene_envs.supports import Contacts, Placed

        supports = torch.full_like(self.categories, -1)
        for start in range(0, len(supports), _CHUNK):
            rows = slice(start, start + _CHUNK)
            poses = self.translations[rows], self.rotations[rows]
            shapes, placed = Placed.of_scenes(self.scene_type, self.categories[rows], *poses)
            supports[rows][placed.scene, placed.slot] = (
                Contacts.of(shapes, placed).holding().counted(placed.slot).support
            )
        return supports

    def is_any_of(self, *names: str) -> Tensor:
        """(B, N) bool: slots that hold one of the named assets.

        Args:
            *names: Asset names, display names ("steamer lid") or groups such as ``"edible"``
                (:data:`scene_envs.assets.ASSET_GROUPS`).

        Raises:
            UnknownNameError: a name is none of these; the nearest known one is offered.

        >>> SceneBatch.empty("dimsum_table", 1, slots=2).is_any_of("furniture")
        tensor([[ True, False]])
        """
        from scene_envs.assets.base import categories_of

        wanted = torch.tensor(categories_of(names, self.scene_type.library), dtype=torch.int64)
        return torch.isin(self.categories, wanted.to(self.categories.device))

    def _of_category(self, table: Tensor) -> Tensor:
        """(B, N, ...) rows of a table (C + 1, ...)."""
        return table.to(self.categories.device)[self.categories]

    def names(self) -> list[list[str]]:
        """Asset names of the non-empty slots, per scene, in slot order."""
        assets, empty = self.scene_type.assets, self.scene_type.num_assets
        return [[assets[c] for c in row if c != empty] for row in self.categories.tolist()]

    def to_tensor(self, *, normalised: Normalizer | None = None) -> Tensor:
        """(B, N, D) float32; raw, or normalised to [-1, 1] when a normalizer is given."""
        return self._tensor if normalised is None else normalised.normalize(self._tensor)

    def to(self, device: str | torch.device) -> SceneBatch:
        """The same scenes on another torch device."""
        return SceneBatch(self._tensor.to(device), self.scene_type)

    def with_slots(self, slots: int) -> SceneBatch:
        """The same scenes with more (empty) slots, or with fewer when the dropped ones are empty."""
        if slots < self._tensor.shape[1]:
            if bool((~self.is_empty[:, slots:]).any()):
                needed = 1 + int(torch.nonzero(~self.is_empty)[:, 1].max())
                raise InvalidInputError(
                    f"slots={slots}: the scenes have an object in slot {needed - 1}; at least {needed} slots hold them"
                )
            return SceneBatch(self._tensor[:, :slots], self.scene_type)
        extra = self._tensor.new_zeros(len(self), slots - self._tensor.shape[1], self.scene_type.features)
        extra[..., -1] = 1.0
        return SceneBatch(torch.cat([self._tensor, extra], dim=1), self.scene_type)

    def with_poses(self, translations: Tensor, rotations: Tensor) -> SceneBatch:
        """The same objects at new poses; (B, N, 3) m and (B, N, 3, 3)."""
        return SceneBatch.from_parts(translations, rotations, self.categories, self.scene_type)

    def keeping(self, kept: Tensor) -> SceneBatch:
        """The scenes without the free objects that are not in ``kept`` (B, N)."""
        categories = self.categories.masked_fill(self.is_free & ~kept, self.scene_type.num_assets)
        return SceneBatch.from_parts(self.translations, self.rotations, categories, self.scene_type)

    def __len__(self) -> int:
        return self._tensor.shape[0]

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> SceneBatch:
        """A sub-batch; an integer keeps the batch dimension."""
        if isinstance(index, int):
            if not -len(self) <= index < len(self):
                raise IndexError(f"scene {index} of a batch of {len(self)}")
            index = [index]
        return SceneBatch(self._tensor[index], self.scene_type)

    def __repr__(self) -> str:
        return f"SceneBatch({self.scene_type.name!r}, {tuple(self._tensor.shape)})"

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write to one ``.safetensors`` file, atomically."""
        return write_tensors(path, {"scenes": self._tensor}, {"scene_type": self.scene_type.name})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SceneBatch:
        """Read a file written by :meth:`save`."""
        try:
            tensors, metadata = read_tensors(path)
            return cls(tensors["scenes"], metadata["scene_type"])
        except FileNotFoundError:
            raise InvalidInputError(f"no scene file at {str(path)!r}") from None
        except UnknownNameError:
            raise
        except KeyError as error:
            raise CorruptFileError(f"{str(path)!r} is not a scene file written by SceneBatch.save: {error}") from error


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


def require_rigid_poses(batch: SceneBatch) -> None:
    """Raise InvalidInputError for a pose that is not finite, and for a matrix that is not a rotation."""
    present = ~batch.is_empty
    finite = torch.isfinite(batch.tensor[..., POSE]).all(dim=-1)
    product = batch.rotations.transpose(-1, -2) @ batch.rotations - torch.eye(3, device=batch.tensor.device)
    rotation = (product.abs().amax(dim=(-1, -2)) < _ORTHOGONAL) & (torch.linalg.det(batch.rotations) > 0)
    for good, what in ((finite, "a pose that is not finite"), (rotation, "a matrix that is not a rotation")):
        bad = torch.nonzero(present & ~good)
        if len(bad):
            scene, slot = bad[0].tolist()
            raise InvalidInputError(
                f"scene {scene}, slot {slot} holds {what}: {batch.tensor[scene, slot, POSE].tolist()}; "
                "SceneBatch.from_tensor turns the output of a sampler into valid poses"
            )


def _require_scene_tensor(tensor: Tensor, scene_type: SceneType) -> None:
    if tensor.ndim != 3 or tensor.shape[-1] != scene_type.features:
        raise InvalidInputError(
            f"scenes of {scene_type.name!r} are (B, N, {scene_type.features}) tensors, got shape {tuple(tensor.shape)}"
        )
    if not bool(torch.isfinite(tensor).all()):
        scene, slot, feature = torch.nonzero(~torch.isfinite(tensor))[0].tolist()
        raise InvalidInputError(
            f"scene tensor holds {tensor[scene, slot, feature].item()} at scene {scene}, slot {slot}, "
            f"feature {feature}; all values must be finite"
        )


PlacedObjects = tuple[Index, Array]
"""Objects of one scene: categories (n,), ascending, and positions (n, 3) m."""


def cutoff(scene_type: SceneType) -> float:
    """The cost (m) of an object without counterpart: a quarter of the longer horizontal side of the workspace.

    >>> cutoff(get_scene_type("dimsum_table"))
    0.245
    """
    low, high = scene_type.workspace
    return 0.25 * max(high[0] - low[0], high[1] - low[1])


class SceneObjects:
    """The counted objects of each scene of a batch, sorted by category; each scene is computed on first use."""

    def __init__(self, batch: SceneBatch) -> None:
        self._present = counted_objects(batch).cpu().numpy()
        self._categories = batch.categories.cpu().numpy()
        self._positions = batch.translations.double().cpu().numpy()
        self._known: dict[int, PlacedObjects] = {}

    def __len__(self) -> int:
        return len(self._present)

    def __iter__(self) -> Iterator[PlacedObjects]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, row: int) -> PlacedObjects:
        if row not in self._known:
            slots = np.flatnonzero(self._present[row])
            slots = slots[np.argsort(self._categories[row, slots], kind="stable")]
            self._known[row] = self._categories[row, slots], self._positions[row, slots]
        return self._known[row]


def counted_objects(batch: SceneBatch) -> Tensor:
    """(B, N) bool: objects without the fixed welded ones that are in every scene."""
    fixed = torch.tensor(batch.scene_type.fixed_categories, dtype=torch.long, device=batch.tensor.device)
    return ~batch.is_empty & ~torch.isin(batch.categories, fixed)


def matching_distance(first: PlacedObjects, second: PlacedObjects, limit: float) -> float:
    """Distance (m) of two scenes as sets of objects; orientations do not count.

    This is the OSPA distance of order 1 (Schuhmacher, Vo and Vo, 2008). Objects are matched one to one at the least
    total cost. A match costs the distance of the two positions, at most ``limit`` (m), or ``limit`` when the assets
    differ; an object without a match costs ``limit``, as :func:`cutoff` gives it. The total is divided by the number of
    objects of the larger scene. The assignment is exact: the limit of Sinkhorn iterations as their regularisation goes
    to zero.
    """
    from scipy.optimize import linear_sum_assignment

    count, larger = len(first[0]), max(len(first[0]), len(second[0]))
    if not larger:
        return 0.0
    apart = np.sqrt(((first[1][:, None] - second[1][None]) ** 2).sum(axis=-1))
    cost = np.where(first[0][:, None] == second[0][None], np.minimum(apart, limit), limit)
    rows, columns = linear_sum_assignment(cost)
    matched = float(cost[rows, columns].sum())
    return (matched + limit * (larger - min(count, len(second[0])))) / larger


def check_same_assets(batch: SceneBatch, other: SceneBatch) -> None:
    """Raise InvalidInputError when two batches hold scenes of other assets."""
    if batch.scene_type.assets != other.scene_type.assets:
        raise InvalidInputError(
            f"scenes of {batch.scene_type.name!r} cannot be compared with scenes of {other.scene_type.name!r}: "
            "their assets differ"
        )
