"""``scene-envs evaluate``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from agents.cli.commands.scenes import draw, draw_scenes, load_prior
from agents.cli.run_folder import Run
from agents.configuration.composition import MEASURE_NAMES, DrawKeys, OutputKeys, check_same_keys
from scene_envs.errors import (
    FINITE,
    CorruptFileError,
    Count,
    InvalidInputError,
    MissingDependencyError,
    Natural,
    at_least,
    unknown_name,
)
from scene_envs.files import with_digest, without_digest, write_text

if TYPE_CHECKING:
    from agents.priors.prior import ScenePrior
    from scene_envs.scene import SceneBatch

_SAMPLES, _PROMPTED = "scenes.safetensors", "prompted.safetensors"
_NOT_PART = ("measures", "project", "pictures", "workers", "device", "output")
"""Keys that change no figure of a group."""
_OF_PROMPTS = {"prompt_count", "guidance", "claim_guidance"}
"""Keys that change only the figures of the group ``prompts``."""


@dataclass
class EvaluateConfig(DrawKeys, OutputKeys):
    """Measures of a prior's raw samples, each beside that of real scenes.

    Attributes:
        prior: a shipped name, or the folder of a prior or a run.
        data: dataset folder on which the prior was trained; several, joined by commas, for a prior of several scene
            types. Empty compares with fresh scenes of the grammar and leaves out novelty.
        heldout: dataset folder of held-out scenes; empty takes the last scenes of data.
        training_scenes: number of random scenes of data among which novelty looks for the nearest.
        count: number of samples, and of real scenes in each of the two sets for comparison.
        prompt_count: number of samples with prompts of held-out scenes, at most count; null takes count.
        guidance: weight of classifier-free guidance for the samples with prompts, 0 for none.
        claim_guidance: strength with which samples are guided to the numbers and places that their prompts give, 0 for
            none.
        seed: seed of the samples, the real scenes and the classifiers.
        measures: all, or some of layout, physics, ready, stability, fsd, novelty, prompts, classifier, renders, written
            as layout or [layout, physics].
        project: include ready, the measures after projection and settling, in all.
        pictures: number of samples in gallery.png; 0 draws none.
        output: folder for metrics.json, metrics.md, scenes.safetensors and gallery.png; the same command again measures
            only the missing groups.
    """

    prior: str = "dimsum_table"
    data: str = ""
    heldout: str = ""
    training_scenes: Count = 20_000
    count: Annotated[int, at_least(2)] = 200
    prompt_count: int | None = None
    guidance: Annotated[float, FINITE] = 0.0
    claim_guidance: Annotated[float, at_least(0)] = 0.0
    measures: Any = "all"
    project: bool = True
    pictures: Natural = 16


def choose_measures(measures: str | Iterable[str], *, project: bool = True) -> list[str]:
    """Names of groups, in their order, from ``"all"``, a name, or a list of names; ``project`` says whether ``"all"``
    includes ``ready``. An UnknownNameError for a name that is no group.

    >>> choose_measures(["novelty", "layout"])
    ['layout', 'novelty']
    """
    names = [measures] if isinstance(measures, str) else measures
    if not isinstance(names, Iterable) or not names:
        raise InvalidInputError(f"measures={measures!r} is no list of names; known: all, {', '.join(MEASURE_NAMES)}")
    for name in names:
        if name not in ("all", *MEASURE_NAMES):
            raise unknown_name("measure", str(name), ["all", *MEASURE_NAMES])
    return [name for name in MEASURE_NAMES if name in names or ("all" in names and (project or name != "ready"))]


def check(settings: EvaluateConfig) -> None:
    """Refuse impossible settings before the prior is read."""
    choose_measures(settings.measures, project=settings.project)
    if settings.heldout and not settings.data:
        raise InvalidInputError("heldout= needs data=, the dataset that the prior was trained on")
    if settings.prompt_count is not None and not 2 <= settings.prompt_count <= settings.count:
        raise InvalidInputError(
            f"prompt_count={settings.prompt_count} must be from 2 to count={settings.count}, whose scenes the prompts "
            "are of; null takes all of them"
        )


def run(settings: EvaluateConfig, run: Run) -> None:
    """Sample, measure group by group, tabulate."""
    from agents.evaluation.measure import EvaluationInputs, RealScenes, compute_measure
    from scene_envs.physics import make_pool

    groups = choose_measures(settings.measures, project=settings.project)
    prior = load_prior(settings)
    results = _Results(run, _identity(settings, prior))
    missing = [name for name in groups if name not in results.groups]
    real = RealScenes.load(
        prior.scene_type,
        settings.count,
        data=settings.data,
        heldout=settings.heldout,
        training=settings.training_scenes,
        seed=settings.seed,
    )
    if len(real.floor) < settings.count:
        results.notes.append(
            f"real scenes: {len(real.floor)} in each of the two sets, samples: {settings.count}; distances and "
            "divergences are larger with fewer scenes, so compare them at equal numbers"
        )
        run.log(results.notes[-1])
    samples = results.scenes(_SAMPLES, lambda: draw(prior, settings, settings.count, batch_size=settings.batch_size))
    draw_scenes(samples, settings.pictures, run, "gallery.png")
    optional = settings.measures == "all" or "all" in settings.measures
    with make_pool(settings.workers, physics=settings.physics) as pool:
        inputs = EvaluationInputs(
            samples,
            real,
            (lambda prompts: results.scenes(_PROMPTED, lambda: _prompted(prior, settings, prompts)))
            if prior.conditional
            else None,
            pool,
            settings.seed,
            settings.prompt_count,
        )
        for name in missing:
            started = time.perf_counter()
            try:
                figures = compute_measure(name, inputs)
            except (InvalidInputError, MissingDependencyError) as error:
                if not optional and not isinstance(error, MissingDependencyError):
                    raise
                results.left_out[name] = str(error)
                run.log(f"{name} not measured: {error}")
            else:
                if inputs.left_out:
                    parts = (f"{figure} figures: {reason}" for figure, reason in inputs.left_out.items())
                    results.left_out[name] = "; ".join(parts)
                    inputs.left_out.clear()
                if name == "prompts":
                    claims = {"prompt_claim_guidance": settings.claim_guidance} if settings.claim_guidance else {}
                    figures = {"prompt_guidance": settings.guidance, **claims, **figures}
                results.groups[name] = figures
                results.write()
                run.log(f"{name} measured in {time.perf_counter() - started:.1f} s")
    report = results.report(groups)
    write_text(run.directory / "metrics.md", report + "\n")
    run.say(report)


def _read_figures(path: Path) -> tuple[dict[str, Any], dict[str, dict[str, float]]]:
    """The identity of the figures in ``metrics.json``, and the figures by group, without groups of which a part was
    left out; both empty where there are none. A CorruptFileError if the file is cut off or was changed.
    """
    try:
        found = dict(json.loads(path.read_text(encoding="utf-8"))).get("evaluation")
        if found is None:
            return {}, {}
        found = without_digest(found, path)
        return dict(found["identity"]), {k: v for k, v in found["groups"].items() if k not in found["left_out"]}
    except FileNotFoundError:
        return {}, {}
    except CorruptFileError as error:
        raise CorruptFileError(f"{str(error).partition(';')[0]}; remove it to measure anew") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CorruptFileError(f"{str(path)!r} is cut off or damaged; remove it to measure anew") from error


class _Results:
    """Figures by group, written to ``metrics.json`` after each group, and the samples that they are of.

    Figures in the folder of ``run`` are kept as far as they depend on the same ``identity``: keys, and the digest of
    the prior. An InvalidInputError if they were measured with other keys; other keys of the prompts are allowed.
    """

    def __init__(self, run: Run, identity: dict[str, Any]) -> None:
        self.run_, self.identity = run, identity
        self.left_out: dict[str, str] = {}
        self.notes: list[str] = []
        self._sampling = {key: float(identity[key]) for key in ("num_steps", "physics_guidance")}
        path = run.directory / "metrics.json"
        known, self.groups = _read_figures(path)
        changed = {key for key in {*known, *identity} if known.get(key) != identity.get(key)}
        if not changed:
            return
        check_same_keys(run.directory, known, identity, ("digest", *_OF_PROMPTS), EvaluateConfig)
        stale = [_PROMPTED]
        if known and changed <= _OF_PROMPTS:
            if self.groups.pop("prompts", None) is not None:
                run.say(f"{path} has other {' and '.join(sorted(changed))}: measuring the prompts anew")
        else:
            self.groups, stale = {}, [_SAMPLES, _PROMPTED]
            if known:
                run.say(f"{path} is of other weights of this prior: measuring anew")
        for name in stale:
            (run.directory / name).unlink(missing_ok=True)
        self.write()

    def scenes(self, name: str, draw: Callable[[], SceneBatch]) -> SceneBatch:
        """The scenes in the file ``name``, drawn when it is not there."""
        from scene_envs.scene import SceneBatch

        path: Path = self.run_.directory / name
        if path.is_file():
            return SceneBatch.load(path)
        batch = draw()
        batch.save(path)
        return batch

    def write(self) -> None:
        """``metrics.json``: all figures by name, then the same by group."""
        flat = {name: value for figures in self.groups.values() for name, value in figures.items()}
        evaluation = {"identity": self.identity, "groups": self.groups, "left_out": self.left_out}
        self.run_.write_metrics({**self._sampling, **flat, "evaluation": with_digest(evaluation)})

    def report(self, groups: list[str]) -> str:
        """The figures of ``groups`` as Markdown, and the groups that were not measured."""
        from agents.evaluation.measure import figure_table

        self.write()
        measured = {k: v for name in groups for k, v in self.groups.get(name, {}).items() if v is not None}
        figures = {**self._sampling, **measured}
        notes = [f"- {name} not measured: {reason}" for name, reason in self.left_out.items()]
        notes += [f"- {text}" for text in self.notes]
        return "\n".join([figure_table(figures), *(["", *notes] if notes else [])])


def _identity(settings: EvaluateConfig, prior: ScenePrior) -> dict[str, Any]:
    """The keys that figures depend on, and a digest of the configuration and the weights of the prior."""
    from agents.priors.card import prior_digest
    from agents.priors.guidance import physics_strength

    keys = {key: value for key, value in vars(settings).items() if key not in _NOT_PART}
    keys["physics_guidance"] = physics_strength(settings.physics_guidance, prior.config, prior.scene_type)
    return {**keys, "digest": prior_digest(prior)}


def _prompted(prior: ScenePrior, settings: EvaluateConfig, prompts: list[str]) -> SceneBatch:
    guidance = {"guidance": settings.guidance, "claim_guidance": settings.claim_guidance}
    return draw(prior, settings, len(prompts), prompt=prompts, batch_size=settings.batch_size, **guidance)
