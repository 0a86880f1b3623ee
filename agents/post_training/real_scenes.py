"""Real scenes for the regularisation and for the guard: from a dataset, or from the grammar."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor

from agents.prior import ScenePrior
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


@dataclass(frozen=True)
class RealScenes:
    """Normalised real scenes, split once and for all.

    Attributes:
        train: (M, N, D) for the regularisation.
        heldout: (K, N, D) for the guard.
    """

    train: Tensor
    heldout: Tensor

    @classmethod
    def split(cls, x0: Tensor, heldout: int) -> RealScenes:
        """The last ``heldout`` scenes of ``x0`` (M, N, D) are held out."""
        if not 0 < heldout < len(x0):
            raise InvalidInputError(f"{len(x0)} real scenes cannot spare {heldout} for the guard; give more scenes")
        return cls(x0[:-heldout], x0[-heldout:])

    def batch(self, count: int, generator: Generator) -> Tensor:
        """(count, N, D) training scenes, drawn with replacement."""
        return self.train[torch.randint(len(self.train), (count,), generator=generator)]


def real_scenes(prior: ScenePrior, source: str, count: int, *, seed: int, slots: int | None = None) -> SceneBatch:
    """``count`` real scenes of the prior's scene type.

    Args:
        prior: whose scene type is wanted.
        source: ``"grammar"``, or the directory of a dataset.
        count: how many; a smaller dataset gives all it has.
        seed: of the grammar, or of the choice of rows.
        slots: slots per scene at least; None takes as many as the prior was trained on. Real scenes keep all
            their slots: a prior reads any number.
    """
    slots = max(prior.scene_type.slots, prior.config.slots if slots is None else slots)
    if source == "grammar":
        from scene_envs.grammars import get_grammar

        rng = np.random.default_rng(seed)
        return get_grammar(prior.scene_type).sample(rng, count).with_slots(slots)
    from scene_envs.datasets import SceneDataset

    if not Path(source).is_dir():
        raise InvalidInputError(f"real_scenes={source!r} is neither 'grammar' nor the directory of a dataset")
    dataset = SceneDataset.load(source)
    rows = torch.randperm(len(dataset.tensor), generator=Generator().manual_seed(seed))[:count]
    batch = SceneBatch(dataset.tensor[rows], prior.scene_type)
    return batch.with_slots(max(slots, batch.tensor.shape[1]))
