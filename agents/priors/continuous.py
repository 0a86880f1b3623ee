"""Continuous prior: Gaussian diffusion on whole slots; categories are real numbers with an arg-max at the end.

Rotations are diffused as one of several representations. Other modules exchange scenes in the scene type's own layout
(translation | rotation matrix | one-hot) only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple
from functools import cached_property

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.diffusion import GaussianStep, ReverseStep, StepTable
from agents.diffusion.gaussian import loss_weights
from agents.networks.denoisers import Denoiser, Observed
from agents.networks.registry import build_network
from agents.networks.text import Text
from agents.priors.config import PriorConfig
from agents.priors.guidance import Hook
from agents.priors.prior import DenoiserOutput, NoisedScenes, ScenePrior, draw_noise, no_text
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.protocols import StepTableLike
from scene_envs.rotations import matrix_to_quaternion, project_to_so3, quaternion_to_matrix
from scene_envs.scene import CATEGORY, ROTATION, TRANSLATION, SceneBatch
from scene_envs.scene_types import SceneType


class ContinuousPrior(ScenePrior):
    """A :class:`~agents.priors.prior.ScenePrior` whose categories are diffused as numbers.

    The denoised tensor x (B, N, D) holds scenes with the representation of rotations that ``config.rotation`` names.
    For ``"matrix"`` it has the scene type's own layout; for the others it is narrower. :meth:`encode` and
    :meth:`decode` convert scenes to x and back.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="continuous")
    >>> mean, std, _ = prior.transition(prior.initial(2, 34), 0, prior.step_table(4))
    >>> mean.shape, bool((std[0] == 0).all())  # the table is known
    (torch.Size([2, 34, 20]), True)
    """

    process_name = "continuous"
    config_type = PriorConfig
    code: SceneCode
    """Scenes as numbers, and back."""

    def _denoiser(self) -> Denoiser:
        self.code = SceneCode(self.scene_type, self.config.rotation, self.normalizer)
        _check_network(self.config, self.code)
        return Denoiser(build_network(self.config.network), self.process)

    # -- scenes and numbers ---------------------------------------------------------------------

    @property
    def features(self) -> int:
        """D, numbers per slot of the denoised tensor."""
        return self.code.features

    @property
    def pose_width(self) -> int:
        """Leading features of the continuous output that are poses."""
        return self.code.pose_width

    @cached_property
    def is_constant(self) -> Tensor:
        """(D,) bool: features that never vary."""
        return self.code.normalizer.is_constant

    def normalised(self, batch: SceneBatch) -> Tensor:
        """(B, N, D) scenes as numbers, before known entries are clamped."""
        return self.code.encode(batch)

    def decode(self, x: Tensor) -> SceneBatch:
        """Scenes from normalised x_0 (B, N, D); known entries take their exact values.

        The category of a slot is the arg-max over those that it can hold. Free slots cannot hold assets of fixed
        objects.
        """
        x = self.clamp(x)
        free, barred = len(self.scene_type.fixed), self.scene_type.fixed_categories
        x[:, free:, [self.code.pose_width + category for category in barred]] = torch.finfo(x.dtype).min
        return self.code.decode(x)

    # -- the reverse chain ----------------------------------------------------------------------

    def transition(self, x_t: Tensor, step: int, table: StepTableLike, *, eta: float = 1.0) -> GaussianStep:
        """p(x_{t-1} | x_t) of scenes (B, N, D); differentiable in the network's parameters. The std is 0 on known
        entries; all of it is 0 at the last step, which is deterministic, and if ``eta`` is 0.
        """
        t, previous = int(table.timesteps[step]), int(table.previous[step])
        self.process.check_stride(t, previous)
        x0 = self.denoiser(x_t, t)
        if self.config.clip:
            x0 = x0.clamp(-self.config.clip, self.config.clip)
        x0_weight, xt_weight, std = self.stride(t, previous, eta, x_t)
        mean = self.clamp(x0_weight * x0 + xt_weight * x_t)
        return GaussianStep(mean, std * self.frame(x_t).moving, x0.detach())

    @torch.no_grad()
    def run_chain(
        self, x: Tensor, table: StepTable, noises: Sequence[Generator] | Generator | None,
        observed: Observed | None = None, text: Text | None = None, guidance: float = 0.0, eta: float = 1.0,
        hook: Hook | None = None, closed: Tensor | None = None, refined: bool = True,
    ) -> Tensor:  # fmt: skip
        """x_0 (B, N, D), as :meth:`ScenePrior.run_chain` describes it; there is no text and no refinement.

        Observed entries have the noise of each level. Closed categories leave the arg-max at the end.
        """
        kept = None if observed is None else observed.entries(self.pose_width)
        for step in range(len(table)):
            if observed is not None and kept is not None:
                noised = self.process.add_noise(observed.x, table.timesteps[step], draw_noise(x, noises))
                x = self.clamp(torch.where(kept, noised, x))
            reverse: ReverseStep = self.transition(x, step, table, eta=eta)
            if hook is not None:
                reverse = hook(step, x, reverse)
            x = reverse.from_noise(draw_noise(x, noises))
        if closed is not None:
            barred = F.pad(closed[:, None].expand(*x.shape[:2], -1), (self.pose_width, 0))
            x = x.masked_fill(barred, torch.finfo(x.dtype).min)
        return x if observed is None or kept is None else torch.where(kept, observed.x, x)

    def noised_loss(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) weighted mean squares of the network's error, over entries that are not known.

        Scenes are weighted by their timestep as ``config.loss_weighting`` says; ``text`` must be None.
        """
        error = self.output(noised, text).continuous - noised.target
        weight = noised.weight[0]
        return (error.square() * weight).sum(dim=(1, 2)) / weight.sum() * noised.scale

    def noised(self, x0: Tensor, generator: Generator | None = None, t: Tensor | None = None) -> NoisedScenes:
        """Noised scenes, their targets and weights."""
        if t is None:
            t = self.draw_timesteps(x0.shape[0], generator).to(x0.device)
        noise = torch.randn(x0.shape, generator=generator).to(x0.device)
        x_t = self.clamp(self.process.add_noise(x0, t, noise))
        target = self.process.target(x0, x_t, t, noise)
        weight = self.loss_weight(x0.shape[1]).to(x0.device).expand(len(x0), -1, -1)
        scale = loss_weights(self.process.schedule, t, self.config.prediction, self.config.loss_weighting)
        category = x0[..., self.code.pose_width :].argmax(dim=-1)
        return NoisedScenes(x_t, t, target, weight, scale.to(x0.device), category)

    def output(self, noised: NoisedScenes, text: Text | None = None) -> DenoiserOutput:
        """The output (B, N, D) of noised scenes; ``text`` must be None."""
        if text is not None:
            raise no_text(self.scene_type, "")
        return DenoiserOutput(self.denoiser.output(noised.x_t, noised.t))

    def mean_square_error(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """(D,) error of every number of free slots, as :meth:`ScenePrior.mean_square_error` describes it."""
        error = self.denoiser(self.clamp(self.process.add_noise(x0, t, noise)), t) - x0
        return error[:, len(self.scene_type.fixed) :].square().mean(dim=(0, 1))


def _check_network(config: PriorConfig, code: SceneCode) -> None:
    """Raise InvalidInputError when the network does not fit the denoised tensor."""
    features = getattr(config.network, "features", None)
    if features is None:
        raise InvalidInputError(
            f"{type(config.network).__name__} is not the configuration of a continuous network; see "
            "agents.networks.registry.network_config(name, 'continuous', ...)"
        )
    if features != code.features:
        raise InvalidInputError(
            f"the network reads {features} features, scenes of {config.scene_type!r} with rotation={config.rotation!r} "
            f"have {code.features}; build it with features={code.features}"
        )
    if getattr(config.network, "text_width", 0):
        raise InvalidInputError("text_width must be 0 in the network of a continuous prior, which reads no prompts")


# -- representations of rotations -----------------------------------------------------------------


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
    if rotation == "matrix":
        return matrices.flatten(-2)
    quaternion = _canonical(matrix_to_quaternion(matrices.double()))
    if rotation == "axis_angle":
        import roma

        return roma.unitquat_to_rotvec(quaternion.roll(-1, dims=-1), shortest_arc=False).to(matrices.dtype)
    return quaternion.to(matrices.dtype)


def decode_rotations(code: Tensor, rotation: str) -> Tensor:
    """Inverse of :func:`encode_rotations` that makes rotations (..., 3, 3) from any finite numbers (..., R).

    Matrices are projected to SO(3), quaternions are normalised (zeros become the identity).

    >>> decode_rotations(torch.tensor([0.0, 0.0, 2 * torch.pi]), "axis_angle").round().abs()
    tensor([[1., 0., 0.],
            [0., 1., 0.],
            [0., 0., 1.]])
    """
    if rotation == "matrix":
        return project_to_so3(code.unflatten(-1, (3, 3)))
    if rotation == "axis_angle":
        import roma

        return roma.rotvec_to_rotmat(code.double()).to(code.dtype)
    quaternion = code.double()
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
        scene_type: scene type of the scenes.
        rotation: one of :data:`ROTATIONS`.
        normalizer: normalizer of raw scenes in the scene type's layout.

    Attributes:
        normalizer: normalizer of the F numbers; numbers that it calls constant never vary.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table")
    >>> code = SceneCode(prior.scene_type, "quaternion", prior.normalizer)
    >>> code.features, code.normalizer.is_constant[code.rotation_slice].tolist()  # (w, x, y, z): objects turn about z
    (15, [False, True, True, False])
    """

    def __init__(self, scene_type: SceneType, rotation: str, normalizer: Normalizer) -> None:
        if rotation not in ROTATIONS:
            raise unknown_name("rotation", rotation, ROTATIONS)
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


def _canonical(quaternion: Tensor) -> Tensor:
    """q or -q of quaternions (..., 4), which are one rotation: that with w >= 0; for half turns, the axis decides."""
    w, axis = quaternion[..., 0], quaternion[..., 1:]
    first = (axis.abs() > _HALF_TURN).to(torch.int8).argmax(dim=-1, keepdim=True)
    leading = axis.gather(-1, first).squeeze(-1)
    negative = torch.where(w.abs() < _HALF_TURN, leading < 0, w < 0)
    return torch.where(negative[..., None], -quaternion, quaternion)


def _code_normalizer(normalizer: Normalizer, rotation: str) -> Normalizer:
    """The normalizer of scene codes, made from one of raw scenes."""
    turns = _free_axes(normalizer).float()
    if rotation == "quaternion":
        low, high = torch.cat([torch.zeros(1), -turns]), torch.cat([torch.ones(1), turns])
    else:
        low, high = -math.pi * turns, math.pi * turns
    middle = Normalizer.from_range(low, high)
    pairs = zip(astuple(normalizer), astuple(middle), strict=True)
    return Normalizer(*(torch.cat([own.cpu()[TRANSLATION], new, own.cpu()[CATEGORY]]) for own, new in pairs))


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
