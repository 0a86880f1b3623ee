"""Hydra configurations, packaged so that an installed wheel finds them: one file per command."""
