"""Tables of figures with their floors and a line on how to read each."""

from __future__ import annotations

import re
from collections.abc import Mapping

from agents.evaluation.measure import FLOOR_PREFIX
from agents.evaluation.prompt_following import CHANCE_PREFIX

_HEADS = ("figure", "samples", "real", "how to read")
_NOT_SHOWN = frozenset({"category_kl"})
"""Figures that the table leaves out, because they are shown under another name, in units of 1e-4."""

READING: dict[str, str] = {
    "num_steps": "denoiser evaluations per sample",
    "physics_guidance": "strength of physics guidance of all samples",
    "scenes": "samples measured",
    "objects_mean": "objects per scene, welded ones included",
    "objects_min": "in the emptiest scene",
    "objects_max": "in the fullest scene",
    "free_objects_mean": "objects per scene that are not welded",
    "category_kl_e4": "KL(real ‖ samples) of the shares of assets, in 10⁻⁴ nats; lower is better",
    "count_wasserstein": "distance of the distributions of objects per scene, in objects; lower is better",
    "spacing_wasserstein_mm": "distance of the distributions of distances between neighbours; lower is better",
    "tallest_stack_mean": "objects in the tallest stack of a scene",
    "stack_wasserstein": "distance of the distributions of the tallest stack, in objects; lower is better",
    "workspace_fraction": "objects in the workspace; higher is better",
    "out_of_workspace_rate": "free objects outside the workspace; lower is better",
    "duplicates": "samples that repeat another within 1 cm; lower is better",
    r"height_error_(\w+)_p95_mm": "95 % quantile of the same",
    r"height_error_(\w+)_mm": "median distance in height to the support ({}); lower is better",
    "median_total_penetration_cm": "per scene, summed over pairs of convex parts (the literature's); lower is better",
    "median_total_pair_penetration_cm": "per scene, the deepest overlap of each pair of objects; lower is better",
    "collision_rate": "scenes with two objects more than 1 mm in each other; lower is better",
    "furniture_collision_rate": "rooms in which a table or shelf is more than 1 mm in another; lower is better",
    "overlapping_pairs": "penetrating pairs of objects per scene; lower is better",
    "overlap_median_mm": "depth over the penetrating pairs; lower is better",
    "overlap_p95_mm": "95 % quantile of the same",
    "deeper_than_1mm_fraction": "free objects more than 1 mm in another; lower is better",
    "deeper_than_1cm_fraction": "free objects more than 1 cm in another; lower is better",
    "stable_fraction": "free objects that stay within 1 mm and 0.01 rad in simulation; higher is better",
    "invalid_fraction": "scenes that the physics could not judge",
    "feasible_objects": "free objects per scene that are neither deep in others nor move; higher is better",
    "feasible_fraction": "the same as a share of free objects; higher is better",
    "ready_invalid_fraction": "scenes that could not be made ready",
    "ready_objects": "feasible objects per scene after projection and settling; higher is better",
    "ready_fraction": "the same as a share of free objects; higher is better",
    "classifier_accuracy": "accuracy of a set transformer, samples against real scenes; 0.5 is chance, lower is better",
    "classifier_accuracy_std": "its spread over the seeds",
    "render_accuracy": "accuracy of a CNN on their semantic renders; 0.5 is chance, lower is better",
    "render_accuracy_std": "its spread over the seeds",
    "frechet_scene_distance": "FSD, on features of a frozen set encoder (no FID); lower is better",
    "frechet_inception_distance": "FID of semantic renders; lower is better",
    "prompt_guidance": "weight of classifier-free guidance of the samples with prompts; 0 for none",
    "prompt_following": "samples of which every claim of their prompt is true; higher is better",
    r"prompt_(counts|names|relations)": "the same among prompts on {}",
    r"prompt_(counts|names|relations)_number": "how many prompts on {} there are",
    "prompt_score": "mean partial credit; higher is better",
    r"chance_prompt_\w+": "real scenes with the prompts of others: what ignoring the prompt scores",
    "novelty": "median distance to the nearest training scene, over that of real scenes; 0 for copies, 1 when new",
    "nearest_training_cm": "median distance per object to the nearest training scene",
    "copied_fraction": "samples that repeat a training scene within 1 cm; lower is better",
}
"""How to read each figure, by its name or a pattern of it."""


def figure_table(figures: Mapping[str, float]) -> str:
    """The figures as a Markdown table: samples, the real-against-real floor, and how to read each.

    The category KL is shown in units of 1e-4 nats, as the paper prints it.

    >>> print(figure_table({"objects_mean": 18.0, "floor_objects_mean": 18.25}))
    | figure | samples | real | how to read |
    |---|---|---|---|
    | objects_mean | 18 | 18.25 | objects per scene, welded ones included |
    """
    lines = ["| " + " | ".join(_HEADS) + " |", "|---" * len(_HEADS) + "|"]
    for name, value in figures.items():
        if name.startswith(FLOOR_PREFIX) or name in _NOT_SHOWN:
            continue
        cells = (name, _number(value), _number(figures.get(FLOOR_PREFIX + name)), how_to_read(name))
        if name.startswith(CHANCE_PREFIX):  # a figure of real scenes, shown in their column
            cells = (name, "", _number(value), how_to_read(name))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def how_to_read(name: str) -> str:
    """A line on how to read the figure ``name``; empty for an unknown figure.

    >>> how_to_read("height_error_stack_mm")
    'median distance in height to the support (stack); lower is better'
    """
    for pattern, text in READING.items():
        found = re.fullmatch(pattern, name)
        if found:
            return text.format(*found.groups())
    return ""


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"
