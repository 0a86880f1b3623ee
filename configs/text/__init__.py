"""Options of the group ``text``."""
