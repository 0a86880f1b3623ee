"""Measures by group: what one evaluation computes, each group on its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from agents.evaluation.measure import FLOOR_PREFIX, layout_figures
from agents.evaluation.novelty import Neighbors, nearest_scenes, novelty
from agents.evaluation.physics_figures import physics_figures, ready_figures
from agents.evaluation.prompt_following import own_prompts, prompt_chance, prompt_following
from agents.evaluation.real_scenes import RealScenes
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool

Figures = dict[str, float]


@dataclass(frozen=True)
class Material:
    """What an evaluation works on.

    Attributes:
        samples: raw samples of a prior.
        real: real scenes.
        follow: scenes of the prior for prompts, one each; None for a prior that reads none.
        pool: physics workers; None computes in this process.
        seed: of classifiers and prompts.
        fid_weights: path of the weights of an Inception-v3; empty for none.
        prompts: real scenes whose prompts are followed; None for all of them.

    >>> empty = SceneBatch.empty("dimsum_table", 2)
    >>> measure_group("layout", Material(empty, RealScenes(empty, empty)))["floor_objects_mean"]
    1.0
    """

    samples: SceneBatch
    real: RealScenes
    follow: Callable[[list[str]], SceneBatch] | None = None
    pool: PhysicsPool | None = None
    seed: int = 0
    fid_weights: str = ""
    prompts: int | None = None


def measure_group(name: str, material: Material) -> Figures:
    """The figures of one group, each with its floor: the same of real scenes against other real scenes.

    Raises:
        UnknownNameError: no such group.
        InvalidInputError: the group needs what the material lacks.
        MissingDependencyError: it needs a package that is not installed.
    """
    if name not in GROUPS:
        raise unknown_name("measure", name, GROUPS)
    return GROUPS[name](material)


def choose_groups(measures: str | Iterable[str], *, project: bool = True) -> list[str]:
    """Names of groups, in their order.

    Args:
        measures: ``"all"``, a name, names joined by commas, or a list of names.
        project: whether ``"all"`` includes ``ready``.

    Raises:
        UnknownNameError: a name that is no group.

    >>> choose_groups("novelty, layout")
    ['layout', 'novelty']
    """
    names = [name.strip() for name in measures.split(",")] if isinstance(measures, str) else [*map(str, measures)]
    if names == ["all"]:
        return [name for name in GROUPS if project or name != "ready"]
    for name in names:
        if name not in GROUPS:
            raise unknown_name("measure", name, ["all", *GROUPS])
    return [name for name in GROUPS if name in names]


def _beside_floor(measure: Callable[[SceneBatch], Figures], material: Material) -> Figures:
    """Figures of the samples, and of other real scenes as floor."""
    real = {FLOOR_PREFIX + name: value for name, value in measure(material.real.floor).items()}
    return {**measure(material.samples), **real}


def _layout(material: Material) -> Figures:
    return _beside_floor(lambda batch: layout_figures(batch, material.real.reference), material)


def _physics(material: Material) -> Figures:
    return _beside_floor(lambda batch: physics_figures(batch, material.pool), material)


def _ready(material: Material) -> Figures:
    return _beside_floor(lambda batch: ready_figures(batch, material.pool), material)


def _classifier(material: Material) -> Figures:
    from agents.evaluation.classifier import classifier_accuracy

    def measure(batch: SceneBatch) -> Figures:
        accuracy = classifier_accuracy(material.real.reference, batch, seed=material.seed)
        return {"classifier_accuracy": accuracy.mean, "classifier_accuracy_std": accuracy.std}

    return _beside_floor(measure, material)


def _renders(material: Material) -> Figures:
    from agents.evaluation.render_classifier import render_classifier_accuracy

    def measure(batch: SceneBatch) -> Figures:
        accuracy = render_classifier_accuracy(material.real.reference, batch, seed=material.seed)
        return {"render_accuracy": accuracy.mean, "render_accuracy_std": accuracy.std}

    return _beside_floor(measure, material)


def _fsd(material: Material) -> Figures:
    from agents.evaluation.frechet import frechet_scene_distance

    return _beside_floor(
        lambda batch: {"frechet_scene_distance": frechet_scene_distance(batch, material.real.reference)}, material
    )


def _fid(material: Material) -> Figures:
    from agents.evaluation.inception import frechet_inception_distance

    if not material.fid_weights:
        raise InvalidInputError("FID needs fid_weights=, the path of an Inception-v3's weights")

    def measure(batch: SceneBatch) -> Figures:
        distance = frechet_inception_distance(batch, material.real.reference, material.fid_weights)
        return {"frechet_inception_distance": distance}

    return _beside_floor(measure, material)


def _prompts(material: Material) -> Figures:
    if material.follow is None:
        raise InvalidInputError("prompt-following needs a prior that reads prompts, and this one was trained without")
    scenes = material.real.floor[: material.prompts]
    prompts = own_prompts(scenes, material.seed)
    figures = prompt_following(material.follow(prompts), prompts)
    real = {FLOOR_PREFIX + name: value for name, value in prompt_following(scenes, prompts).items()}
    return {**figures, **real, **prompt_chance(scenes, prompts, material.seed)}


def _novelty(material: Material) -> Figures:
    training = material.real.training
    if training is None:
        raise InvalidInputError("novelty needs data=, the dataset that the prior was trained on")
    held_out = nearest_scenes(material.real.reference, training)

    def figures(found: Neighbors) -> Figures:
        return {
            "novelty": novelty(found, held_out),
            "nearest_training_cm": 100 * float(found.distance.median()),
            "copied_fraction": float(found.copied.double().mean()),
        }

    return _beside_floor(lambda batch: figures(nearest_scenes(batch, training)), material)


GROUPS: dict[str, Callable[[Material], Figures]] = {
    "layout": _layout,
    "physics": _physics,
    "ready": _ready,
    "fsd": _fsd,
    "novelty": _novelty,
    "prompts": _prompts,
    "classifier": _classifier,
    "renders": _renders,
    "fid": _fid,
}
"""Groups of measures, in the order in which they are computed: cheap ones first."""
