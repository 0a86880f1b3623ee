"""``python -m agents.cli``, which is ``scene-envs``."""

from agents.cli.parser import entry_point

entry_point()
