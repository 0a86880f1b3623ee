"""Flags of observed entries: tell the network which poses and categories carry no noise (inpainting)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from agents.networks.flux_modules import FluxModule, FluxSizes, ModuleConfig, Scene


@dataclass(frozen=True)
class ObservedFlagsConfig(ModuleConfig):
    """An embedding of which entries of a slot are observed."""

    name = "observed_flags"
    place = "slots"

    def build(self, core: FluxSizes) -> ObservedFlags:
        return ObservedFlags(core.embedding)


class ObservedFlags(FluxModule):
    """An embedding (B, N, E) of what is observed (neither, pose, category or both); it starts at zero."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(4, width)
        nn.init.zeros_(self.embedding.weight)

    def slot_features(self, scene: Scene) -> Tensor | None:
        if scene.observed is None:
            return None
        return self.embedding(scene.observed)
