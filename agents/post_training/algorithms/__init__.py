"""Post-training algorithms: one file for each family."""
