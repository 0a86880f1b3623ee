"""Options of the group ``scene``."""
