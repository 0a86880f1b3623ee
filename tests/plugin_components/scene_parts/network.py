"""A network: MiDiffusion under another name, with a size of its own."""

from dataclasses import dataclass

from agents.networks import MixedMiDiffusion, MixedMiDiffusionConfig, register_network


@dataclass(frozen=True, kw_only=True)
class ThinConfig(MixedMiDiffusionConfig):
    """Feed-forward layers as wide as the tokens."""

    mlp_ratio: float = 1.0
    frequencies: int = 0


class Thin(MixedMiDiffusion):
    """MiDiffusion with narrow feed-forward layers."""


register_network("thin", "mixed", ThinConfig, Thin)
