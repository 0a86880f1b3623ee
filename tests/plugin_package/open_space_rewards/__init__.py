"""Rewards of a package of its own."""
