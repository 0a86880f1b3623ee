"""Denoiser networks."""

from agents.networks.flux import FluxConfig, FluxDenoiser
from agents.networks.mixed_flux import MixedFlux, MixedFluxConfig
from agents.networks.text import TextConfig, TextEncoder, vocabulary

__all__ = [
    "FluxConfig",
    "FluxDenoiser",
    "MixedFlux",
    "MixedFluxConfig",
    "TextConfig",
    "TextEncoder",
    "vocabulary",
]
