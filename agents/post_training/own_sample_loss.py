"""Base class of losses of finished scenes at random timesteps of the forward process, as torchrl losses."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Generator, Tensor
from torchrl.objectives import LossModule

from agents.networks.text import Text
from agents.priors.base import ScenePrior
from agents.priors.forward import NoisedScenes


class PlainLoss(LossModule):
    """A torchrl loss whose gradient goes to the modules' own parameters, and which has no value estimator."""

    @property
    def functional(self) -> bool:
        """False: the modules' own parameters receive the gradient."""
        return False

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        """Does nothing: there is no value estimator."""


class OwnSampleLoss(PlainLoss):
    """A loss of finished scenes x_0; each call noises every scene once.

    A subclass defines the losses of noised scenes. :meth:`forward` returns their means over the valid scenes.

    Accepted keys (``set_keys``):
        scene: (B, N, D) float, finished scenes x_0 as the prior encodes them. Default ``"scene"``.
        timestep: (B,) or (B, 1) int64, optional; without it, drawn as in pretraining. Default ``"timestep"``.
        valid: (B,) or (B, 1) bool, optional; False rows are left out of the mean. Default ``"valid"``.
        text, text_mask: (B, L, W) tokens and (B, L) their mask, optional. Default ``"text"`` and ``"text_mask"``.

    Args:
        prior: noises the scenes.
        generator: source of timesteps, noise and observed entries (CPU); None for torch's own.

    Returns (``forward``): ``loss_objective`` (), the loss of the prior in training, and ``loss_expectation`` (), the
        loss of a copy that is trained beside it. Each is 0 if the scenes do not train that model.
    """

    @dataclass
    class _AcceptedKeys:
        scene: NestedKey = "scene"
        timestep: NestedKey = "timestep"
        valid: NestedKey = "valid"
        text: NestedKey = "text"
        text_mask: NestedKey = "text_mask"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_objective", "loss_expectation"]  # noqa: RUF012  (torchrl reads lists)
    prior: ScenePrior
    generator: Generator | None

    def __init__(self, prior: ScenePrior, *, generator: Generator | None = None) -> None:
        super().__init__()
        self.prior = prior
        self.generator = generator

    @property
    def in_keys(self) -> list[NestedKey]:  # type: ignore[override]
        """Keys that must be present."""
        return [self.tensor_keys.scene]

    @abstractmethod
    def of_scenes(self, noised: NoisedScenes, text: Text | None, flat: TensorDictBase) -> Mapping[str, Tensor]:
        """Values of ``out_keys``: (B,) with one per scene, or () for a value that is not a mean over scenes."""

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of finished scenes."""
        flat = tensordict.reshape(-1)
        timestep = flat.get(self.tensor_keys.timestep, None)
        scene = flat.get(self.tensor_keys.scene).detach()
        t = None if timestep is None else timestep.reshape(-1)
        return self.of_noised(self.prior.noised(scene, self.generator, t), flat)

    def of_noised(self, noised: NoisedScenes, flat: TensorDictBase) -> TensorDict:
        """The loss of a batch of shape [B] whose scenes the prior has noised already."""
        keys = self.tensor_keys
        tokens, mask = flat.get(keys.text, None), flat.get(keys.text_mask, None)
        text = None if tokens is None or mask is None else (tokens.detach(), mask)
        scene, valid = flat.get(keys.scene), flat.get(keys.valid, None)
        kept = torch.ones(len(scene), dtype=torch.bool, device=scene.device) if valid is None else valid.reshape(-1)
        count = kept.sum().clamp(min=1)
        found = {
            name: torch.where(kept, value, 0.0).sum() / count if value.ndim else value
            for name, value in self.of_scenes(noised, text, flat).items()
        }
        return TensorDict(found, [])
