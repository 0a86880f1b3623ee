"""Evaluation: measures of scenes against real scenes."""

from agents.evaluation.classifier import Accuracy, ClassifierConfig, classifier_accuracy
from agents.evaluation.layouts import nearest_scenes, novelty, spacing_wasserstein, stack_wasserstein, tallest_stacks
from agents.evaluation.measure import (
    evaluate,
    figure_table,
    grammar_scenes,
    measure_samples,
    own_prompts,
    prompt_following,
)
from agents.evaluation.physics_figures import physics_figures, stable_fraction
from agents.evaluation.pictures import frechet_scene_distance, render_classifier_accuracy

__all__ = [
    "Accuracy",
    "ClassifierConfig",
    "classifier_accuracy",
    "evaluate",
    "figure_table",
    "frechet_scene_distance",
    "grammar_scenes",
    "measure_samples",
    "nearest_scenes",
    "novelty",
    "own_prompts",
    "physics_figures",
    "prompt_following",
    "render_classifier_accuracy",
    "spacing_wasserstein",
    "stable_fraction",
    "stack_wasserstein",
    "tallest_stacks",
]
