"""Options of the group ``reward``."""
