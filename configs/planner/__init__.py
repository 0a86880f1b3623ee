"""Options of the group ``planner``."""
