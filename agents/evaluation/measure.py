"""Evaluation of scenes, and of how they follow prompts: a flat dict of figures for cards, reports and commands."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from agents.configuration.composition import MEASURE_NAMES
from agents.evaluation.classifier import Accuracy, classifier_accuracy
from agents.evaluation.layouts import (
    Neighbors,
    category_kl,
    count_wasserstein,
    duplicates,
    height_errors,
    nearest_scenes,
    novelty,
    out_of_workspace_rate,
    spacing_wasserstein,
    stack_wasserstein,
    tallest_stacks,
    workspace_fraction,
)
from agents.evaluation.physics_figures import physics_figures, ready_figures, stability_figures
from agents.evaluation.pictures import frechet_scene_distance, render_classifier_accuracy
from scene_envs.datasets.prompts import KINDS, describe, parse_prompt, scene_facts
from scene_envs.datasets.prompts.claims import NameCount, ObjectCount
from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.files import page_values
from scene_envs.protocols import PriorLike
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool

FLOOR_PREFIX = "floor_"
"""Prefix of the figures of real scenes measured against other real scenes."""
CHANCE_PREFIX = "chance_"
"""Prefix of the figures of real scenes measured against prompts of other real scenes."""
_FLOOR_SEED = 1_000_003
"""Added to the seed of the grammar for the second set of scenes."""

Figures = dict[str, float]


def measure_samples(
    batch: SceneBatch,
    reference: SceneBatch,
    *,
    floor: SceneBatch | None = None,
    pool: PhysicsPool | None = None,
    ready: bool = True,
) -> dict[str, float]:
    """Measure scenes against reference scenes.

    Objects include welded ones, *free* objects do not. A figure without data, such as the height of stacks in scenes
    without stacks, is left out. Scenes whose physics failed are left out of the figures of that computation; they are
    counted in ``invalid_fraction`` or ``ready_invalid_fraction``.

    Args:
        batch: scenes to measure.
        reference: real scenes of the same type.
        floor: other real scenes; each figure is also measured on them and returned as ``floor_<name>``, the figure of a
            perfect sampler.
        pool: worker processes for physics; None computes in this process.
        ready: whether to also project and settle the scenes, which takes the longest.

    Returns:
        The figures of :func:`layout_figures`, of :func:`~agents.evaluation.physics_figures.physics_figures` and, with
        ``ready``, of :func:`~agents.evaluation.physics_figures.ready_figures`; docs/evaluation.md describes each.

    Raises:
        InvalidInputError: there are no scenes, or they are of another type than the reference.
    """
    if not len(batch) or not len(reference):
        raise InvalidInputError(f"cannot measure {len(batch)} scenes against {len(reference)}: both need at least one")
    figures = layout_figures(batch, reference) | physics_figures(batch, pool)
    figures |= ready_figures(batch, pool) if ready else {}
    real = {} if floor is None else measure_samples(floor, reference, pool=pool, ready=ready)
    return figures | {FLOOR_PREFIX + name: value for name, value in real.items()}


def evaluate(
    prior: PriorLike | str,
    count: int = 500,
    reference: SceneBatch | None = None,
    *,
    floor: SceneBatch | None = None,
    num_steps: int = 50,
    seed: int = 0,
    batch_size: int = 64,
    pool: PhysicsPool | None = None,
    ready: bool = True,
    device: str = "auto",
) -> dict[str, float]:
    """Sample a prior and measure its raw samples: the figures of :func:`measure_samples`, and ``num_steps``.

    Args:
        prior: a prior with a method ``sample``, or the name or path of one.
        count: number of samples.
        reference: real scenes; None draws ``count`` scenes from the grammar of the prior's scene type.
        num_steps: denoiser evaluations per sample.
        seed: seed of the samples, and of the grammar if it is used.
        batch_size: number of scenes denoised at once.
        floor, pool, ready: as for :func:`measure_samples`.
        device: torch device of the network; ``"auto"`` is that of a prior that is given, and for a name the GPU where
            torch finds one, else the CPU.
    """
    sampler: Any = resolve_prior(prior, device)
    if reference is None:
        reference = grammar_scenes(sampler.scene_type, count, seed=seed)
    samples = sampler.sample(count, num_steps=num_steps, seed=seed, batch_size=batch_size).to("cpu")
    figures = measure_samples(samples, reference, floor=floor, pool=pool, ready=ready)
    return {"num_steps": float(num_steps), **figures}


def grammar_scenes(scene_type: str | SceneType, count: int, seed: int = 0) -> SceneBatch:
    """``count`` scenes of the grammar of a scene type, the same for the same seed."""
    from scene_envs.grammars import get_grammar

    return get_grammar(scene_type).sample(np.random.default_rng(seed), count)


def layout_figures(batch: SceneBatch, reference: SceneBatch) -> dict[str, float]:
    """Figures that need no simulator: counts, categories, spacing, stacks, heights, workspace and duplicates. An
    InvalidInputError if the scenes are of another type than the reference.
    """
    counts = batch.counts
    divergence = category_kl(batch, reference)
    figures = {
        "scenes": float(len(batch)),
        "objects_mean": float(counts.double().mean()),
        "objects_min": float(counts.min()),
        "objects_max": float(counts.max()),
        "free_objects_mean": int(batch.is_free.sum()) / len(batch),
        "category_kl": divergence,
        "category_kl_e4": 1e4 * divergence,
        "count_wasserstein": count_wasserstein(batch, reference),
        "workspace_fraction": workspace_fraction(batch),
        "out_of_workspace_rate": out_of_workspace_rate(batch),
        "duplicates": duplicates(batch),
    }
    spacing = spacing_wasserstein(batch, reference)
    if spacing is not None:
        figures["spacing_wasserstein_mm"] = 1e3 * spacing
    if batch.scene_type.has_geometry:
        figures["tallest_stack_mean"] = float(tallest_stacks(batch).double().mean())
        figures["stack_wasserstein"] = stack_wasserstein(batch, reference)
    for kind, errors in height_errors(batch).items():
        if len(errors):
            figures[f"height_error_{kind}_mm"] = 1e3 * float(errors.quantile(0.5))
            figures[f"height_error_{kind}_p95_mm"] = 1e3 * float(errors.quantile(0.95))
    return figures


@dataclass(frozen=True)
class RealScenes:
    """Disjoint sets of real scenes.

    >>> from scene_envs.scene_types import get_scene_type
    >>> real = RealScenes.load(get_scene_type("dimsum_table"), 2)
    >>> len(real.reference), len(real.floor), real.training
    (2, 2, None)
    """

    reference: SceneBatch  # held out; samples are compared with these
    floor: SceneBatch  # held out too, equivalent to samples of a perfect sampler
    training: SceneBatch | None = None  # the prior may have seen these; None if the others are from the grammar

    @classmethod
    def load(
        cls, scene_type: SceneType, count: int, *, data: str = "", heldout: str = "", training: int = 20_000,
        seed: int = 0,
    ) -> RealScenes:  # fmt: skip
        """At most ``count`` held-out scenes in each of the two sets, and ``training`` training scenes, drawn at random
        from the dataset folders ``data``, joined by commas; empty takes fresh scenes of the grammar and no training
        scenes. ``heldout`` names folders too; empty takes the last scenes of ``data``, at most half of it. An
        InvalidInputError for a folder that does not exist, scenes of another type, or fewer than four held-out scenes;
        a CorruptFileError for a file that cannot be read, lacks a column, or holds rows that are not scenes.
        """
        if not data:
            if heldout:
                raise InvalidInputError(f"heldout={heldout!r} needs data=, the folder of the training scenes")
            return cls(
                grammar_scenes(scene_type, count, seed), grammar_scenes(scene_type, count, seed + _FLOOR_SEED), None
            )
        folders, held_folders = _folders(data), _folders(heldout)
        if heldout and len(held_folders) != len(folders):
            raise InvalidInputError(
                f"data names {len(folders)} folders and heldout {len(held_folders)}; give the same number"
            )
        share = -(-count // len(folders))
        parts = [
            _split(folder, held, scene_type, share, -(-training // len(folders)), seed)
            for folder, held in zip(folders, held_folders or [""] * len(folders), strict=True)
        ]
        slots = max(part.tensor.shape[1] for group in parts for part in group)
        reference, floor, train = (
            _in_turn([part.with_slots(slots) for part in group]) for group in zip(*parts, strict=True)
        )
        return cls(reference, floor, train)


def _split(
    folder: str, heldout: str, scene_type: SceneType, count: int, training: int, seed: int
) -> tuple[SceneBatch, SceneBatch, SceneBatch]:
    """Reference, floor and training scenes of one folder; no scene is in two of them."""
    from scene_envs.datasets.dataset import scene_keys

    whole = _read(folder, scene_type)
    if heldout:
        held, train = _distinct(_read(heldout, scene_type)), whole
    else:
        kept = min(2 * count, len(whole) // 2)
        held, train = _distinct(whole[len(whole) - kept :]), whole[: len(whole) - kept]
    half = min(count, len(held) // 2)
    if half < 2:
        raise InvalidInputError(
            f"{heldout or folder!r} has {len(held)} distinct held-out scenes; at least 4 are needed, half of them for "
            "the real-against-real floor: generate more, or name a folder with more as heldout="
        )
    train = train[~np.isin(scene_keys(train), scene_keys(held))]
    if not len(train):
        raise InvalidInputError(
            f"all scenes of data={folder!r} are held-out scenes too; novelty has nothing to compare"
        )
    order = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))[:training]
    batches = (held[:half], held[half : 2 * half], train[order])
    return tuple(SceneBatch(tensor, scene_type) for tensor in batches)  # type: ignore[return-value]


def _in_turn(parts: list[SceneBatch]) -> SceneBatch:
    """The scenes of all parts, in turn, so that any first scenes are from all parts."""
    numbers = torch.cat([torch.arange(len(part)) for part in parts])
    return SceneBatch.concatenate(parts)[numbers.argsort(stable=True)]


def _read(folder: str, scene_type: SceneType) -> Tensor:
    """(M, N, D) raw scenes of a dataset, in the categories of ``scene_type``."""
    from scene_envs.datasets import SceneDataset, to_union

    if not Path(folder).exists():
        raise InvalidInputError(f"no dataset at {folder!r}; scene-envs generate makes one")
    dataset = SceneDataset.load(folder)
    if dataset.scene_type.assets == scene_type.assets:
        return dataset.tensor
    if dataset.scene_type.name not in scene_type.name.split("+"):
        raise InvalidInputError(
            f"{folder!r} holds scenes of {dataset.scene_type.name!r}, the samples are of {scene_type.name!r}; name a "
            "dataset of that scene type"
        )
    return to_union(dataset.batch(), scene_type).tensor


def _distinct(tensor: Tensor) -> Tensor:
    from scene_envs.datasets.dataset import scene_keys

    _, first = np.unique(scene_keys(tensor), return_index=True)
    return tensor[torch.from_numpy(np.sort(first))]


def _folders(text: str) -> list[str]:
    return [folder.strip() for folder in text.split(",") if folder.strip()]


@dataclass(frozen=True)
class EvaluationInputs:
    """Inputs of an evaluation.

    >>> empty = SceneBatch.empty("dimsum_table", 2)
    >>> compute_measure("layout", EvaluationInputs(empty, RealScenes(empty, empty)))["floor_objects_mean"]
    1.0
    """

    samples: SceneBatch  # raw samples of a prior
    real: RealScenes
    follow: Callable[[list[str]], SceneBatch] | None = None  # samples a scene per prompt; None without prompts
    pool: PhysicsPool | None = None  # None computes in this process
    seed: int = 0  # of the classifiers and prompts
    prompts: int | None = None  # number of real scenes whose prompts the samples follow; None for all
    left_out: dict[str, str] = field(default_factory=dict)  # gets figures that this machine cannot compute, and why


def compute_measure(name: str, inputs: EvaluationInputs) -> Figures:
    """The figures of one group, each with its floor: the same figure of real scenes against other real scenes. Raises
    an UnknownNameError, an InvalidInputError for inputs that lack something, or a MissingDependencyError for a
    package.
    """
    if name not in MEASURES:
        raise unknown_name("measure", name, MEASURE_NAMES)
    return MEASURES[name](inputs)


def _with_floor(measure: Callable[[SceneBatch], Figures], inputs: EvaluationInputs) -> Figures:
    """Figures of the samples, and the same figures of other real scenes as floor."""
    real = {FLOOR_PREFIX + name: value for name, value in measure(inputs.real.floor).items()}
    return {**measure(inputs.samples), **real}


def _accuracy(name: str, classify: Callable[..., Accuracy], inputs: EvaluationInputs) -> Figures:
    def measure(batch: SceneBatch) -> Figures:
        accuracy = classify(inputs.real.reference, batch, seed=inputs.seed)
        return {name: accuracy.mean, f"{name}_std": accuracy.std}

    return _with_floor(measure, inputs)


def _prompts(inputs: EvaluationInputs) -> Figures:
    if inputs.follow is None:
        raise InvalidInputError("prompt-following needs a prior that reads prompts, and this one was trained without")
    scenes = inputs.real.floor[: inputs.prompts]
    prompts = own_prompts(scenes, inputs.seed)
    figures = prompt_following(inputs.follow(prompts), prompts)
    real = {FLOOR_PREFIX + name: value for name, value in prompt_following(scenes, prompts).items()}
    return {**figures, **real, **prompt_chance(scenes, prompts, inputs.seed)}


def _novelty(inputs: EvaluationInputs) -> Figures:
    training = inputs.real.training
    if training is None:
        raise InvalidInputError("novelty needs data=, the dataset that the prior was trained on")
    held_out = nearest_scenes(inputs.real.reference, training)

    def figures(found: Neighbors) -> Figures:
        return {
            "novelty": novelty(found, held_out),
            "nearest_training_cm": 100 * float(found.distance.median()),
            "copied_fraction": float(found.copied.double().mean()),
        }

    return _with_floor(lambda batch: figures(nearest_scenes(batch, training)), inputs)


MEASURES: dict[str, Callable[[EvaluationInputs], Figures]] = {
    "layout": lambda inputs: _with_floor(lambda batch: layout_figures(batch, inputs.real.reference), inputs),
    "physics": lambda inputs: _with_floor(lambda batch: physics_figures(batch, inputs.pool, inputs.left_out), inputs),
    "ready": lambda inputs: _with_floor(lambda batch: ready_figures(batch, inputs.pool), inputs),
    "stability": lambda inputs: _with_floor(lambda batch: stability_figures(batch, inputs.pool), inputs),
    "fsd": lambda inputs: _with_floor(
        lambda batch: {"frechet_scene_distance": frechet_scene_distance(batch, inputs.real.reference)}, inputs
    ),
    "novelty": _novelty,
    "prompts": _prompts,
    "classifier": lambda inputs: _accuracy("classifier_accuracy", classifier_accuracy, inputs),
    "renders": lambda inputs: _accuracy("render_accuracy", render_classifier_accuracy, inputs),
}
"""Groups of measures, in the order in which they are computed: cheap ones first."""


def figure_table(figures: Mapping[str, float]) -> str:
    """The figures as a Markdown table: samples, the real-against-real floor, and how to read each.

    The category KL is shown in units of 1e-4 nats, as the paper prints it.

    >>> print(figure_table({"objects_mean": 18.0, "floor_objects_mean": 18.25}))
    | figure | samples | real | how to read |
    |---|---|---|---|
    | objects_mean | 18 | 18.25 | objects per scene, welded ones included |
    """
    lines = ["| figure | samples | real | how to read |", "|---|---|---|---|"]
    for name, value in figures.items():
        if name.startswith(FLOOR_PREFIX) or name == "category_kl":  # shown as category_kl_e4
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
    for pattern, text in page_values("agents.evaluation", "reading.yaml").items():
        found = re.fullmatch(pattern, name)
        if found:
            return str(text).format(*found.groups())
    return ""


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def prompt_following(batch: SceneBatch, prompts: Sequence[str]) -> dict[str, float]:
    """Share of B scenes that follow their own one of B prompts, the paper's prompt-following accuracy.

    A prompt is followed if every claim in it is true of the scene. The numbers of the named objects must be exact.
    Relations have the tolerances in docs/prompts.md.

    Returns:
        ``prompt_following``: share of all prompts followed. ``prompt_counts``, ``prompt_names`` and
        ``prompt_relations``: the same among prompts of that kind, where there are any. ``prompt_counts_number`` and
        so on: the number of prompts of that kind. ``prompt_score``: mean partial credit in [0, 1], 1 only when every
        prompt is followed.

    Raises:
        InvalidInputError: there is not one prompt per scene, or a prompt cannot be read.

    >>> scenes = SceneBatch.empty("dimsum_table", 2)
    >>> figures = prompt_following(scenes, ["A scene with 1 object.", "A scene with a teapot."])
    >>> figures["prompt_following"], figures["prompt_counts"], figures["prompt_names"]
    (0.5, 1.0, 0.0)
    """
    if len(prompts) != len(batch) or not prompts:
        raise InvalidInputError(f"{len(prompts)} prompts for {len(batch)} scenes; give one prompt per scene")
    asked = [parse_prompt(prompt, batch.scene_type) for prompt in prompts]
    checks = [prompt.check(scene) for prompt, scene in zip(asked, scene_facts(batch), strict=True)]
    followed = np.array([all(check.holds for check in each) for each in checks])
    first = [prompt.claims[0] for prompt in asked]
    counts = np.array([isinstance(claim, ObjectCount) for claim in first])
    names = np.array([isinstance(claim, NameCount) for claim in first])
    figures = {"prompt_following": float(followed.mean())}
    for kind, rows in {"counts": counts, "names": names, "relations": ~(counts | names)}.items():
        if rows.any():
            figures |= {f"prompt_{kind}": float(followed[rows].mean()), f"prompt_{kind}_number": float(rows.sum())}
    scores = [np.mean([check.score for check in each]) for each in checks]
    return {**figures, "prompt_score": float(np.mean(scores))}


def prompt_chance(batch: SceneBatch, prompts: Sequence[str], seed: int = 0) -> dict[str, float]:
    """Shares of :func:`prompt_following` by chance, ``chance_<name>``: each scene has the prompt of another. An
    InvalidInputError for fewer than two scenes.
    """
    if len(batch) < 2:
        raise InvalidInputError(f"chance needs at least 2 scenes to exchange prompts, got {len(batch)}")
    order = np.random.default_rng(seed).permutation(len(prompts))
    others = np.empty_like(order)
    others[order] = np.roll(order, 1)  # one cycle: no scene keeps its own prompt
    figures = prompt_following(batch, [prompts[i] for i in others])
    return {CHANCE_PREFIX + name: value for name, value in figures.items() if not name.endswith("_number")}


def own_prompts(batch: SceneBatch, seed: int = 0) -> list[str]:
    """One prompt per scene that is true of it; counts, names and relations take turns.

    A scene that has no relations to describe gets a prompt on its number of objects.

    >>> own_prompts(SceneBatch.empty("dimsum_table", 1))
    ['A scene with 1 object.']
    """
    rng = np.random.default_rng(seed)
    prompts = [""] * len(batch)
    for turn, kind in enumerate(KINDS[: len(batch)]):
        prompts[turn :: len(KINDS)] = describe(batch[turn :: len(KINDS)], rng, kinds=[kind])
    return prompts
