"""Denoiser networks."""

from agents.networks.diffuscene import DiffuScene, DiffuSceneConfig, MixedDiffuScene, MixedDiffuSceneConfig
from agents.networks.flux import FluxConfig, FluxDenoiser
from agents.networks.midiffusion import MiDiffusion, MiDiffusionConfig, MixedMiDiffusion, MixedMiDiffusionConfig
from agents.networks.mixed_flux import MixedFlux
from agents.networks.mixed_flux_config import MixedFluxConfig
from agents.networks.parameters import match_parameters, parameter_count
from agents.networks.registry import NETWORKS, build_network, list_networks, network_config, register_network
from agents.networks.text import TextConfig, TextEncoder

__all__ = [
    "NETWORKS",
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
    "match_parameters",
    "network_config",
    "parameter_count",
    "register_network",
]
