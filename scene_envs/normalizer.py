"""Per-feature affine normalisation of scene tensors to [-1, 1]."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from scene_envs.arrays import constant_on
from scene_envs.errors import InvalidInputError

_ZERO_RANGE = 1e-6
"""Features whose range over the data is below this (m, or rotation entries) count as constant."""


@dataclass(frozen=True)
class Normalizer:
    """The map ``x' = x * scale + min`` per feature, with constant features kept exact.

    A feature whose range over the data is zero has ``scale = 0``: it is 0 when normalised, and
    :meth:`unnormalize` returns its constant for any sampled value.

    Attributes:
        scale: (D,) float32; 0 marks a constant feature.
        min: (D,) float32 offset of the normalised value.
        input_min: (D,) float32, smallest raw value (metres for translations).
        input_max: (D,) float32, largest raw value.

    >>> data = torch.tensor([[[0.0, 5.0], [2.0, 5.0]]])
    >>> normalizer = Normalizer.fit(data)
    >>> normalizer.normalize(data)
    tensor([[[-1.,  0.],
             [ 1.,  0.]]])
    >>> bool((normalizer.unnormalize(torch.tensor([0.5, 0.3])) == torch.tensor([1.5, 5.0])).all())
    True
    """

    scale: Tensor
    min: Tensor
    input_min: Tensor
    input_max: Tensor

    @classmethod
    def fit(cls, data: Tensor) -> Normalizer:
        """Fit on raw scene tensors ``data`` (..., D)."""
        flat = data.reshape(-1, data.shape[-1]).float()
        return cls.from_range(flat.amin(dim=0), flat.amax(dim=0))

    @classmethod
    def from_range(cls, input_min: Tensor, input_max: Tensor) -> Normalizer:
        """The normalizer that maps [``input_min``, ``input_max``] (D,) to [-1, 1]."""
        span = input_max - input_min
        constant = span < _ZERO_RANGE
        safe = torch.where(constant, torch.ones_like(span), span)
        scale = torch.where(constant, torch.zeros_like(span), 2.0 / safe)
        offset = torch.where(constant, torch.zeros_like(span), -1.0 - input_min * (2.0 / safe))
        return cls(scale.float(), offset.float(), input_min.float(), input_max.float())

    @cached_property
    def is_constant(self) -> Tensor:
        """(D,) bool: features that never vary."""
        return self.scale == 0

    def normalize(self, raw: Tensor) -> Tensor:
        """Raw (..., D) to normalised (..., D)."""
        self._require_width(raw)
        return raw * self._on(self.scale, raw) + self._on(self.min, raw)

    def unnormalize(self, normalised: Tensor) -> Tensor:
        """Normalised (..., D) to raw (..., D); constant features take their constant."""
        self._require_width(normalised)
        constant = constant_on(self.is_constant, normalised.device)
        scale = self._on(self.scale, normalised)
        raw = (normalised - self._on(self.min, normalised)) / torch.where(constant, torch.ones_like(scale), scale)
        return torch.where(constant, self._on(self.input_min, normalised), raw)

    @staticmethod
    def _on(constant: Tensor, like: Tensor) -> Tensor:
        return constant_on(constant, like.device).to(like.dtype)

    def _require_width(self, x: Tensor) -> None:
        if x.shape[-1] != self.scale.shape[0]:
            raise InvalidInputError(
                f"the normalizer was fitted on {self.scale.shape[0]} features, the tensor has {x.shape[-1]} "
                f"(shape {tuple(x.shape)}); were they made for the same scene type?"
            )

    def state(self) -> dict[str, Any]:
        """JSON-able state in the layout of the published ``normalizer_state``."""
        return {
            "params": {
                "scale": self.scale.tolist(),
                "min": self.min.tolist(),
                "input_stats": {"min": self.input_min.tolist(), "max": self.input_max.tolist()},
            },
            "is_fitted": True,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Normalizer:
        """Inverse of :meth:`state`.

        Raises:
            InvalidInputError: an entry is missing, or the four entries are not lists of finite numbers of one length.
        """
        try:
            params = state["params"]
            stats = params["input_stats"]
            vectors = [params["scale"], params["min"], stats["min"], stats["max"]]
        except (KeyError, TypeError) as error:
            raise InvalidInputError(
                f"normalizer_state lacks {error}; it needs params.scale, .min, .input_stats"
            ) from error
        try:
            scale, offset, low, high = (torch.as_tensor(vector, dtype=torch.float32) for vector in vectors)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise InvalidInputError(f"normalizer_state holds values that are no numbers: {str(error)[:200]}") from error
        numbers = (scale, offset, low, high)
        shapes = {tuple(vector.shape) for vector in numbers}
        if len(shapes) > 1 or scale.ndim != 1 or not all(bool(torch.isfinite(vector).all()) for vector in numbers):
            raise InvalidInputError(
                f"normalizer_state needs four lists of finite numbers of one length, it has shapes {sorted(shapes)}"
            )
        return cls(scale, offset, low, high)
