"""The command line: ``scene-envs COMMAND key=value …``."""

from agents.cli.main import entry_point, main

__all__ = ["entry_point", "main"]
