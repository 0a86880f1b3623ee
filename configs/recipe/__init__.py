"""Options of the group ``recipe``."""
