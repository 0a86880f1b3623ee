"""``python -m agents.cli``, which is ``scene-envs``."""

from agents.cli.main import entry_point

entry_point()
