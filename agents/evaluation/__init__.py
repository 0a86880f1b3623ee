"""Evaluation: measures of scenes against real scenes."""

from agents.evaluation.classifier import classifier_accuracy
from agents.evaluation.frechet import frechet_scene_distance
from agents.evaluation.inception import frechet_inception_distance
from agents.evaluation.measure import evaluate, grammar_scenes, measure_samples
from agents.evaluation.novelty import nearest_scenes, novelty
from agents.evaluation.physics_figures import physics_figures, stable_fraction
from agents.evaluation.prompt_following import own_prompts, prompt_following
from agents.evaluation.render_classifier import render_classifier_accuracy
from agents.evaluation.report import figure_table
from agents.evaluation.spacing import spacing_wasserstein
from agents.evaluation.stacks import stack_wasserstein, tallest_stacks
from agents.evaluation.two_sample_test import Accuracy, ClassifierConfig

__all__ = [
    "Accuracy",
    "ClassifierConfig",
    "classifier_accuracy",
    "evaluate",
    "figure_table",
    "frechet_inception_distance",
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
