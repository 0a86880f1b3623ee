"""Hydra configurations, packaged so that an installed wheel finds them: groups of options, recipes."""
