"""Scenes of a package of its own."""
