"""Tables of post-training: training runs, measured samples, and what they cost."""
