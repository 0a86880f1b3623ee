"""Denoiser networks."""

from agents.networks.baselines import DiffuSceneConfig, MiDiffusionConfig, MixedDiffuSceneConfig, MixedMiDiffusionConfig
from agents.networks.flux import FluxConfig, FluxDenoiser, MixedFlux, MixedFluxConfig
from agents.networks.registry import build_network, list_networks, network_config, register_network
from agents.networks.text import TextConfig, TextEncoder

__all__ = [
    "DiffuSceneConfig",
    "FluxConfig",
    "FluxDenoiser",
    "MiDiffusionConfig",
    "MixedDiffuSceneConfig",
    "MixedFlux",
    "MixedFluxConfig",
    "MixedMiDiffusionConfig",
    "TextConfig",
    "TextEncoder",
    "build_network",
    "list_networks",
    "network_config",
    "register_network",
]
