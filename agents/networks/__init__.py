"""Denoiser networks."""

from agents.networks.flux import FluxConfig, FluxDenoiser

__all__ = ["FluxConfig", "FluxDenoiser"]
