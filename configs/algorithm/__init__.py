"""Options of the group ``algorithm``."""
