"""Options of the group ``process``."""
