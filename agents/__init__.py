"""What learns and what plans: priors, post-training, planning, evaluation, the command line."""
