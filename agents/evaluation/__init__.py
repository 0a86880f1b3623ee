"""How good scenes are, in numbers."""

from agents.evaluation.classifier import classifier_accuracy
from agents.evaluation.frechet import frechet_scene_distance
from agents.evaluation.inception import frechet_inception_distance
from agents.evaluation.measure import evaluate_prior, grammar_scenes, layout_figures, measure_samples
from agents.evaluation.metrics import (
    category_distribution,
    category_kl,
    count_wasserstein,
    height_errors,
    out_of_workspace_rate,
    workspace_fraction,
)
from agents.evaluation.novelty import Neighbors, duplicates, nearest_scenes, novelty, scene_distances
from agents.evaluation.physics_figures import (
    collision_rate,
    penetration_totals,
    physics_figures,
    ready_figures,
    stable_fraction,
)
from agents.evaluation.prompt_following import own_prompts, prompt_chance, prompt_following
from agents.evaluation.render_classifier import render_classifier_accuracy
from agents.evaluation.report import figure_table, how_to_read
from agents.evaluation.supports import CONTAINERS, SUPPORTS, Container, Support
from agents.evaluation.two_sample_test import Accuracy, JudgeConfig

__all__ = [
    "CONTAINERS",
    "SUPPORTS",
    "Accuracy",
    "Container",
    "JudgeConfig",
    "Neighbors",
    "Support",
    "category_distribution",
    "category_kl",
    "classifier_accuracy",
    "collision_rate",
    "count_wasserstein",
    "duplicates",
    "evaluate_prior",
    "figure_table",
    "frechet_inception_distance",
    "frechet_scene_distance",
    "grammar_scenes",
    "height_errors",
    "how_to_read",
    "layout_figures",
    "measure_samples",
    "nearest_scenes",
    "novelty",
    "out_of_workspace_rate",
    "own_prompts",
    "penetration_totals",
    "physics_figures",
    "prompt_chance",
    "prompt_following",
    "ready_figures",
    "render_classifier_accuracy",
    "scene_distances",
    "stable_fraction",
    "workspace_fraction",
]
