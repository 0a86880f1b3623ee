"""The figures of one line of a table."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from benchmarks.paper_tables.data import HeldoutScenes
from benchmarks.paper_tables.settings import TablesConfig
from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    from agents.priors.prior import ScenePrior
    from scene_envs.physics import PhysicsPool
    from scene_envs.scene import SceneBatch

logger = logging.getLogger(__name__)


def sample_and_measure(
    prior: ScenePrior, real: HeldoutScenes, settings: TablesConfig, *, prompted: bool, pool: PhysicsPool | None
) -> dict[str, float]:
    """Figures of ``prior``: of samples without prompts, or of those that were given the prompts of real scenes."""
    if prompted and not real.prompts:
        raise InvalidInputError(f"the scenes of {settings.heldout or settings.data!r} have no prompts to follow")
    samples = prior.sample(
        len(real.prompts) if prompted else settings.measured,
        prompt=list(real.prompts) if prompted else None,
        guidance=settings.guidance if prompted else 0.0,
        num_steps=settings.steps,
        seed=settings.seed,
    ).to("cpu")
    return measure(samples, real.reference, real.prompts if prompted else (), settings, pool)


def measure_real(real: HeldoutScenes, settings: TablesConfig, pool: PhysicsPool | None) -> dict[str, float]:
    """Figures of real scenes against other real scenes: no sampler can be expected to do better.

    With prompts, ``chance_prompt_counts`` and so on are those of real scenes that were given the prompts of others.
    """
    figures = measure(real.others, real.reference, real.prompts, settings, pool)
    return {**figures, **(_collect({"chance": lambda: _chance(real)}) if real.prompts else {})}


def measure(
    samples: SceneBatch,
    reference: SceneBatch,
    prompts: Sequence[str],
    settings: TablesConfig,
    pool: PhysicsPool | None,
) -> dict[str, float]:
    """The figures of the tables' columns that can be measured and are finite.

    If a measure refuses these scenes (too few of them for a classifier, say), its columns are left out and the log gets
    a line.

    Args:
        samples: what is measured.
        reference: real scenes.
        prompts: those that the samples were given, one each; empty for none.
        settings: sizes of the measures.
        pool: physics workers.
    """
    from agents.evaluation import measure_samples

    figures: dict[str, Any] = dict(measure_samples(samples, reference, pool=pool, ready=False))
    valid = len(samples) * (1.0 - figures.get("invalid_fraction", 0.0))
    figures["free_objects"] = round(figures["free_objects_mean"] * valid)
    measures: dict[str, Callable[[], Mapping[str, float]]] = {
        "classifier accuracy": lambda: _classifier(samples, reference, settings),
        "FSD": lambda: _frechet(samples, reference),
    }
    if prompts:
        measures["prompt-following"] = lambda: _prompts(samples, prompts)
    figures.update(_collect(measures))
    return {
        name: float(value) for name, value in figures.items() if isinstance(value, int | float) and math.isfinite(value)
    }


def _collect(measures: Mapping[str, Callable[[], Mapping[str, float]]]) -> dict[str, float]:
    """The figures of all measures but those that refuse these scenes, which are logged."""
    figures: dict[str, float] = {}
    for name, compute in measures.items():
        try:
            figures.update(compute())
        except (ImportError, InvalidInputError) as error:
            logger.warning("%s is left out: %s", name, error)
    return figures


def _classifier(samples: SceneBatch, reference: SceneBatch, settings: TablesConfig) -> dict[str, float]:
    from agents.evaluation.classifier import classifier_accuracy

    accuracy = classifier_accuracy(reference, samples, seeds=settings.preset.classifier_seeds)
    return {"classifier_accuracy": accuracy.mean, "classifier_accuracy_std": accuracy.std}


def _frechet(samples: SceneBatch, reference: SceneBatch) -> dict[str, float]:
    from agents.evaluation.pictures import frechet_scene_distance

    return {"frechet_scene_distance": frechet_scene_distance(samples, reference)}


def _prompts(samples: SceneBatch, prompts: Sequence[str]) -> Mapping[str, float]:
    from agents.evaluation import prompt_following

    return {**prompt_following(samples, prompts), "prompt_following_number": float(len(prompts))}


def _chance(real: HeldoutScenes) -> Mapping[str, float]:
    from agents.evaluation.measure import prompt_chance

    return prompt_chance(real.others, real.prompts)
