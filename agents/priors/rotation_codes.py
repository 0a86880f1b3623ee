"""Rotation codes: the numbers in which a continuous prior diffuses rotations.

Other modules exchange scenes in the scene type's own layout (translation | rotation matrix | one-hot) only.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from scene_envs.errors import unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.rotations import matrix_to_quaternion, project_to_so3, quaternion_to_matrix
from scene_envs.scene import CATEGORY, ROTATION, TRANSLATION, SceneBatch
from scene_envs.scene_types import SceneType

ROTATION_WIDTHS = {"matrix": 9, "quaternion": 4, "axis_angle": 3}
"""Numbers per rotation of each representation."""
ROTATIONS = tuple(ROTATION_WIDTHS)
"""Representations of rotations: a matrix that ends in an SVD, a unit quaternion, or axis times angle."""

_HALF_TURN = 1e-6
"""A quaternion with abs(w) below this is a half turn, for which w does not decide between q and -q."""
_ZERO = 1e-9


def encode_rotations(matrices: Tensor, rotation: str) -> Tensor:
    """Rotation matrices (..., 3, 3) as (..., R) numbers of the representation ``rotation``; same dtype.

    Quaternions are (w, x, y, z) with w >= 0. For a half turn w is 0, and the first of x, y, z that is not 0 is
    positive. Axis-angle vectors are at most pi long, and those of half turns have the sign of the quaternion.

    >>> encode_rotations(torch.diag(torch.tensor([-1.0, -1.0, 1.0])), "quaternion").tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    _check_rotation(rotation)
    if rotation == "matrix":
        return matrices.flatten(-2)
    quaternion = _canonical(matrix_to_quaternion(matrices.double()))
    return (quaternion if rotation == "quaternion" else _to_axis_angle(quaternion)).to(matrices.dtype)


def decode_rotations(code: Tensor, rotation: str) -> Tensor:
    """Inverse of :func:`encode_rotations` that makes rotations (..., 3, 3) from any finite numbers (..., R).

    Matrices are projected to SO(3), quaternions are normalised (zeros become the identity).

    >>> decode_rotations(torch.tensor([0.0, 0.0, 2 * torch.pi]), "axis_angle").round().abs()
    tensor([[1., 0., 0.],
            [0., 1., 0.],
            [0., 0., 1.]])
    """
    _check_rotation(rotation)
    if rotation == "matrix":
        return project_to_so3(code.unflatten(-1, (3, 3)))
    numbers = code.double()
    quaternion = numbers if rotation == "quaternion" else _from_axis_angle(numbers)
    none = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64, device=code.device)
    zero = quaternion.norm(dim=-1, keepdim=True) < _ZERO
    return quaternion_to_matrix(torch.where(zero, none, quaternion)).to(code.dtype)


class SceneCode:
    """Scenes as normalised numbers (B, N, F) of a continuous prior, and back.

    With ``"matrix"`` these are the scene type's own layout under the given normalizer. With the other representations,
    translations and categories are normalised as by the given normalizer, and rotations are scaled by the range of the
    representation. If the range of the given normalizer shows that objects turn about one axis only, or not at all, the
    other components are constant.

    Args:
        scene_type: of the scenes.
        rotation: one of :data:`ROTATIONS`.
        normalizer: of raw scenes in the scene type's layout.

    Attributes:
        normalizer: of the F numbers; what it calls constant never varies.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table")
    >>> code = SceneCode(prior.scene_type, "quaternion", prior.normalizer)
    >>> code.features, code.normalizer.is_constant[code.rotation_slice].tolist()  # (w, x, y, z): things turn about z
    (15, [False, True, True, False])
    """

    def __init__(self, scene_type: SceneType, rotation: str, normalizer: Normalizer) -> None:
        _check_rotation(rotation)
        self.scene_type, self.rotation = scene_type, rotation
        self.normalizer = normalizer if rotation == "matrix" else _code_normalizer(normalizer, rotation)

    @property
    def pose_width(self) -> int:
        """Numbers per pose."""
        return TRANSLATION.stop + ROTATION_WIDTHS[self.rotation]

    @property
    def features(self) -> int:
        """F, numbers per slot."""
        return self.pose_width + self.scene_type.num_assets + 1

    @property
    def rotation_slice(self) -> slice:
        """Entries of the rotation in a slot."""
        return slice(TRANSLATION.stop, self.pose_width)

    def encode(self, batch: SceneBatch) -> Tensor:
        """Normalised (B, N, F) of scenes; the pose of an empty slot is zeros before it is normalised."""
        if self.rotation == "matrix":
            return batch.to_tensor(normalised=self.normalizer)
        rotations = encode_rotations(batch.rotations, self.rotation) * ~batch.is_empty[..., None]
        return self.normalizer.normalize(
            torch.cat([batch.translations, rotations, batch.tensor[..., CATEGORY]], dim=-1)
        )

    def decode(self, x: Tensor) -> SceneBatch:
        """Scenes from normalised numbers (B, N, F): valid rotations, arg-max categories.

        Raises:
            InvalidInputError: ``x`` has another shape or is not finite.
        """
        if self.rotation == "matrix":
            return SceneBatch.from_tensor(x, self.scene_type, normalised=self.normalizer)
        raw = self.normalizer.unnormalize(x.float())
        rotations = decode_rotations(raw[..., self.rotation_slice], self.rotation)
        categories = x[..., self.pose_width :].argmax(dim=-1)
        return SceneBatch.from_parts(raw[..., TRANSLATION], rotations, categories, self.scene_type)


def _check_rotation(rotation: str) -> None:
    if rotation not in ROTATIONS:
        raise unknown_name("rotation", rotation, ROTATIONS)


def _canonical(quaternion: Tensor) -> Tensor:
    """q or -q of quaternions (..., 4), which are one rotation: that with w >= 0; for half turns, the axis decides."""
    w, axis = quaternion[..., 0], quaternion[..., 1:]
    first = (axis.abs() > _HALF_TURN).to(torch.int8).argmax(dim=-1, keepdim=True)
    leading = axis.gather(-1, first).squeeze(-1)
    negative = torch.where(w.abs() < _HALF_TURN, leading < 0, w < 0)
    return torch.where(negative[..., None], -quaternion, quaternion)


def _to_axis_angle(quaternion: Tensor) -> Tensor:
    """(..., 3) axis times angle of unit quaternions (..., 4)."""
    w, vector = quaternion[..., :1], quaternion[..., 1:]
    length = vector.norm(dim=-1, keepdim=True)
    tiny = length < _ZERO  # sin(angle / 2), where angle / length tends to 2
    scale = 2.0 * torch.atan2(length, w) / torch.where(tiny, torch.ones_like(length), length)
    return torch.where(tiny, 2.0 * vector, scale * vector)


def _from_axis_angle(vector: Tensor) -> Tensor:
    """Unit quaternions (..., 4) of axis times angle (..., 3)."""
    angle = vector.norm(dim=-1, keepdim=True)
    sine_over_angle = 0.5 * torch.sinc(angle / (2.0 * math.pi))  # sin(angle / 2) / angle
    return torch.cat([torch.cos(angle / 2), sine_over_angle * vector], dim=-1)


def _code_normalizer(normalizer: Normalizer, rotation: str) -> Normalizer:
    """The normalizer of scene codes, made from one of raw scenes."""
    turns = _free_axes(normalizer).float()
    if rotation == "quaternion":
        low, high = torch.cat([torch.zeros(1), -turns]), torch.cat([torch.ones(1), turns])
    else:
        low, high = -math.pi * turns, math.pi * turns
    middle = Normalizer.from_range(low, high)

    def joined(name: str) -> Tensor:
        own: Tensor = getattr(normalizer, name).cpu()
        return torch.cat([own[TRANSLATION], getattr(middle, name), own[CATEGORY]])

    return Normalizer(joined("scale"), joined("min"), joined("input_min"), joined("input_max"))


def _free_axes(normalizer: Normalizer) -> Tensor:
    """(3,) bool: components of the rotation vector that may vary, from the range of the matrix entries.

    Objects turn about axis k alone if the matrix entries that mix k with another axis are always 0, and the diagonal
    entry of k is never negative.
    """
    low, high = (side[ROTATION].reshape(3, 3).cpu() for side in (normalizer.input_min, normalizer.input_max))
    zero = (low.abs() < _HALF_TURN) & (high.abs() < _HALF_TURN)
    free = torch.ones(3, dtype=torch.bool)
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        alone = bool(zero[axis, others].all() and zero[others, axis].all() and low[axis, axis] > -_HALF_TURN)
        if alone:
            free &= torch.arange(3) == axis
    return free
