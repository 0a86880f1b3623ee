"""Options of the group ``mask``."""
