"""Groups of measures, each computed on its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from agents.configuration import MEASURE_NAMES
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
class EvaluationInputs:
    """Inputs of an evaluation.

    Attributes:
        samples: raw samples of a prior.
        real: real scenes.
        follow: function that samples a scene of the prior for each prompt; None for a prior that reads no prompts.
        pool: physics workers; None computes in this process.
        seed: seed of the classifiers and prompts.
        fid_weights: path of the weights of an Inception-v3; empty for none.
        prompts: number of real scenes whose prompts the samples follow; None for all of them.

    >>> empty = SceneBatch.empty("dimsum_table", 2)
    >>> compute_measure("layout", EvaluationInputs(empty, RealScenes(empty, empty)))["floor_objects_mean"]
    1.0
    """

    samples: SceneBatch
    real: RealScenes
    follow: Callable[[list[str]], SceneBatch] | None = None
    pool: PhysicsPool | None = None
    seed: int = 0
    fid_weights: str = ""
    prompts: int | None = None


def compute_measure(name: str, inputs: EvaluationInputs) -> Figures:
    """The figures of one group, each with its floor: the same figure of real scenes against other real scenes.

    Raises:
        UnknownNameError: no such group.
        InvalidInputError: the inputs lack something that the group needs.
        MissingDependencyError: the group needs a package that is not installed.
    """
    if name not in MEASURES:
        raise unknown_name("measure", name, MEASURE_NAMES)
    return MEASURES[name](inputs)


def _with_floor(measure: Callable[[SceneBatch], Figures], inputs: EvaluationInputs) -> Figures:
    """Figures of the samples, and the same figures of other real scenes as floor."""
    real = {FLOOR_PREFIX + name: value for name, value in measure(inputs.real.floor).items()}
    return {**measure(inputs.samples), **real}


def _classifier(inputs: EvaluationInputs) -> Figures:
    from agents.evaluation.classifier import classifier_accuracy

    def measure(batch: SceneBatch) -> Figures:
        accuracy = classifier_accuracy(inputs.real.reference, batch, seed=inputs.seed)
        return {"classifier_accuracy": accuracy.mean, "classifier_accuracy_std": accuracy.std}

    return _with_floor(measure, inputs)


def _renders(inputs: EvaluationInputs) -> Figures:
    from agents.evaluation.render_classifier import render_classifier_accuracy

    def measure(batch: SceneBatch) -> Figures:
        accuracy = render_classifier_accuracy(inputs.real.reference, batch, seed=inputs.seed)
        return {"render_accuracy": accuracy.mean, "render_accuracy_std": accuracy.std}

    return _with_floor(measure, inputs)


def _fsd(inputs: EvaluationInputs) -> Figures:
    from agents.evaluation.frechet import frechet_scene_distance

    return _with_floor(
        lambda batch: {"frechet_scene_distance": frechet_scene_distance(batch, inputs.real.reference)}, inputs
    )


def _fid(inputs: EvaluationInputs) -> Figures:
    from agents.evaluation.inception import frechet_inception_distance

    if not inputs.fid_weights:
        raise InvalidInputError("FID needs fid_weights=, the path of an Inception-v3's weights")

    real, weights = inputs.real.reference, inputs.fid_weights
    return _with_floor(
        lambda batch: {"frechet_inception_distance": frechet_inception_distance(batch, real, weights)}, inputs
    )


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
    "physics": lambda inputs: _with_floor(lambda batch: physics_figures(batch, inputs.pool), inputs),
    "ready": lambda inputs: _with_floor(lambda batch: ready_figures(batch, inputs.pool), inputs),
    "fsd": _fsd,
    "novelty": _novelty,
    "prompts": _prompts,
    "classifier": _classifier,
    "renders": _renders,
    "fid": _fid,
}
"""Groups of measures, in the order in which they are computed: cheap ones first."""
