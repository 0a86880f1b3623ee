"""How good scenes are, in numbers."""

from agents.evaluation.measure import evaluate_prior, figure_table, grammar_scenes, measure_samples
from agents.evaluation.metrics import (
    category_distribution,
    category_kl,
    count_wasserstein,
    height_errors,
    workspace_fraction,
)
from agents.evaluation.supports import CONTAINERS, SUPPORTS, Container, Support

__all__ = [
    "CONTAINERS",
    "SUPPORTS",
    "Container",
    "Support",
    "category_distribution",
    "category_kl",
    "count_wasserstein",
    "evaluate_prior",
    "figure_table",
    "grammar_scenes",
    "height_errors",
    "measure_samples",
    "workspace_fraction",
]
