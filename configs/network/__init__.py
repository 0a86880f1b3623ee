"""Options of the group ``network``."""
