"""Pooled text: the mean text token joins the embedded time, as in Flux and Stable Diffusion 3."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from agents.networks.flux_modules import FluxModule, FluxSizes, ModuleConfig, Scene


@dataclass(frozen=True)
class PooledTextConfig(ModuleConfig):
    """The mean of the text tokens, which then modulates every block."""

    name = "pooled_text"
    place = "condition"
    reads_text = True

    def build(self, core: FluxSizes) -> PooledText:
        return PooledText(core.text_width, core.hidden)


class PooledText(FluxModule):
    """A linear map (B, H) of the mean text token (B, W)."""

    def __init__(self, text_width: int, hidden: int) -> None:
        super().__init__()
        self.linear = nn.Linear(text_width, hidden, bias=False)

    def condition(self, scene: Scene) -> Tensor | None:
        if scene.summary is None:
            return None
        return self.linear(scene.summary)
