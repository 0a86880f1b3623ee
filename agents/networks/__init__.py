"""Denoiser networks."""

from agents.networks.baselines import (
    DiffuScene,
    DiffuSceneConfig,
    MiDiffusion,
    MiDiffusionConfig,
    MixedDiffuScene,
    MixedDiffuSceneConfig,
    MixedMiDiffusion,
    MixedMiDiffusionConfig,
)
from agents.networks.flux import FluxConfig, FluxDenoiser, MixedFlux, MixedFluxConfig
from agents.networks.registry import (
    build_network,
    list_networks,
    network_config,
    register_network,
)
from agents.networks.text import TextConfig, TextEncoder

__all__ = [
    "DiffuScene",
    "DiffuSceneConfig",
    "FluxConfig",
    "FluxDenoiser",
    "MiDiffusion",
    "MiDiffusionConfig",
    "MixedDiffuScene",
    "MixedDiffuSceneConfig",
    "MixedFlux",
    "MixedFluxConfig",
    "MixedMiDiffusion",
    "MixedMiDiffusionConfig",
    "TextConfig",
    "TextEncoder",
    "build_network",
    "list_networks",
    "network_config",
    "register_network",
]
