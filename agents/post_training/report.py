"""Report of a run: fresh samples of both priors, measured, drawn and written as one self-contained HTML file."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray
from torch import Generator, Tensor

from agents.configuration.composition import config_text
from agents.evaluation.physics_figures import leaving_out, per_scene_and_fraction
from agents.post_training.guard import realism
from agents.post_training.rollouts import PromptDeck, run_prompts, stream_seed
from agents.post_training.run_files import CHECKPOINT_NAME, METRICS_NAME, SCENES_NAME
from agents.post_training.settings import PostTrainConfig
from agents.post_training.trainer import post_train
from agents.priors.prior import ScenePrior
from agents.utils.checkpoints import load_checkpoint
from agents.utils.process_group import ProcessGroup
from rewards import PromptMatch, RewardContext, RewardOutput, evaluate_reward, learned_parts, reward_label
from rewards.process import close_reward
from scene_envs.envs.scoring import resolve_prior
from scene_envs.files import page_part, page_template, write_json, write_text
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool, ReadyResult


SAMPLE_SEED = 100_000
"""Number added to the run's seed for the measured samples, so that their noise differs from that of training."""
PHYSICS_TIMEOUT = 300.0
"""Seconds for a chunk of scenes; long, so that a slow scene on a busy machine does not become invalid."""
_GALLERY, _COLUMNS, _TILE = 12, 3, (400, 300)
"""Number of scenes of a gallery, number of its columns, and width and height of a scene in pixels."""
_LABELS = {
    "reward": "the trained reward",
    "objects": "objects per scene (welded included)",
    "feasible_objects": "feasible free objects, as sampled",
    "feasible_fraction": "their share of free objects",
    "ready_objects": "simulation-ready free objects",
    "ready_fraction": "their share of free objects ",
    "workspace_fraction": "objects in the workspace, as sampled",
    "height_error_table_mm": "height error on the table, median mm",
    "height_error_stack_mm": "height error in stacks, median mm",
    "prompt_match": "match of prompt and scene, 1 at best",
    "reward_invalid": "scenes that the reward could not score",
    "invalid_scenes": "scenes whose simulation was ended",
}
"""Labels of the measured figures on the page."""
_MEASURING = 2.0
"""Time to measure samples, over that to train on as many denoiser evaluations; an estimate for the time left."""


def post_train_and_compare(
    config: PostTrainConfig, *, scenes: int = 256, num_steps: int = 50, prior: ScenePrior | None = None
) -> dict[str, Any]:
    """Post-train, measure the base and the post-trained prior on fresh samples, and write the report.

    Both priors start from the same noise, and every sample is measured. Physics decides which objects are
    simulation-ready.

    Args:
        config: configuration of the run; ``config.output`` gets ``report.html``, ``curve.png``, ``before.png``,
            ``after.png``, ``metrics.json`` and the prior. An interrupted run found there is resumed.
        scenes: number of fresh samples of each prior.
        num_steps: denoiser evaluations per measured sample.
        prior: prior to start from, in place of the one that ``config.prior`` names.

    Returns:
        The numbers of ``metrics.json``: ``before`` and ``after`` (``reward``, ``objects``, ``feasible_objects`` raw,
        ``ready_objects``, and ``prompt_match`` with prompts), ``change``, ``guard``, ``stage_seconds``, and the run's
        own metrics. With several processes, only the first one measures; the others return the run's own metrics.
    """
    from scene_envs.physics import make_pool

    def say(text: str) -> None:
        """Print on stderr what is done next, unless the run shows no progress."""
        if config.progress != "none":
            print(text, file=sys.stderr, flush=True)

    started = time.perf_counter()
    base = cast(ScenePrior, resolve_prior(config.prior if prior is None else prior, config.device))
    steps = 2 * scenes * num_steps / (config.batch_size * config.num_steps)
    result = post_train(config, prior=base, after=_MEASURING * steps)
    if not ProcessGroup.current().is_first:
        return result.metrics
    trained = time.perf_counter()
    seed = config.seed + SAMPLE_SEED
    directory, slots = config.directory, base.config.slots if config.slots is None else config.slots
    prompts = None
    if config.prompt is not None:  # one per sample, from the source of the run's prompts
        batch = SceneBatch.load(directory / SCENES_NAME)
        real = run_prompts(directory, batch, stream_seed(config.seed, "bank"))
        deck = PromptDeck.of(base, config.prompt, 1, slots, real, len(batch))
        prompts = deck.deal(scenes, Generator().manual_seed(seed))
    reward = config.running(config.reward)
    with make_pool(config.workers, PHYSICS_TIMEOUT, config.physics) as pool, ExitStack() as stack:
        stack.callback(close_reward, reward)
        load_learned_rewards(reward, directory, config.guard.scenes, config.seed)

        def measure(prior: ScenePrior) -> Measured:
            return measure_prior(
                prior, scenes, num_steps=num_steps, seed=seed, pool=pool, prompts=prompts, guidance=config.guidance,
                slots=slots, reward=reward,
            )  # fmt: skip

        say(f"measuring {scenes} samples of the base prior, then of the post-trained one")
        before, half = measure(base), time.perf_counter() - trained
        say(f"measuring {scenes} samples of the post-trained prior, about {half:.0f} s")
        after = measure(result.prior)
    seconds = {"training": round(trained - started, 1), "measuring": round(time.perf_counter() - trained, 1)}
    say("drawing the report")
    names = [name for name in ("reward", "objects", "feasible_objects", "ready_objects") if name in before.figures]
    change = {name: _relative(before.figures[name], after.figures.get(name)) for name in names}
    metrics = {"before": before.figures, "after": after.figures, "change": change, **result.metrics}
    metrics |= {"stage_seconds": seconds, "num_steps": num_steps}
    if left_out := {**before.left_out, **after.left_out}:
        metrics["left_out"] = left_out
    settings, reward_words = config.plain(), reward_label(config.plain()["reward"])
    write_report(
        directory / "report.html",
        "run.html",
        title=f"Steering {before.raw.scene_type.name.replace('_', ' ')} toward {reward_words}",
        reward=reward_words,
        algorithm=settings["algorithm"]["name"].upper().replace("_", "-"),
        metrics=metrics,
        before=before.figures,
        after=after.figures,
        left_out=left_out,
        pictures=_draw_pictures(directory, before, after),
        rows=rows_with_change(before.figures, after.figures),
        settings=config_text(settings),
    )
    write_json(directory / METRICS_NAME, metrics)
    return metrics


def load_learned_rewards(reward: Any, directory: Path, heldout: int, seed: int) -> None:
    """Give the parts of a resolved ``reward`` that learn their state at the end of the run in ``directory``, whose
    guard held out ``heldout`` real scenes.
    """
    if parts := learned_parts(reward):
        real = SceneBatch.load(directory / SCENES_NAME)
        state = load_checkpoint(directory / CHECKPOINT_NAME)["learner"]["learned_rewards"]
        for part, own in zip(parts, state, strict=True):
            part.begin(real[: len(real) - heldout], stream_seed(seed, "discriminator"))
            part.load_state_dict(own)


@dataclass(frozen=True)
class Measured:
    """Fresh samples of a prior and their figures. ``objects`` are all, welded included; ``feasible_*`` figures count
    raw free objects, and ``ready_*`` free objects that are feasible and in the workspace after projection and settling.
    Both leave out ``invalid_scenes``, where physics failed. ``reward`` is the trained one, ``reward_invalid`` counts
    scenes that it could not score, ``prompt_match`` is the reward of that name, and ``*_sem`` are standard errors.
    """

    figures: dict[str, float]
    raw: SceneBatch  # raw samples
    ready: SceneBatch | None  # the samples after projection and settling; None without a simulator
    is_ready: Tensor | None  # (B, N) bool, simulation-ready objects of ``ready``
    left_out: Mapping[str, str] = field(default_factory=dict)  # figures that this machine cannot compute, and why


def measure_prior(
    prior: ScenePrior,
    count: int,
    *,
    num_steps: int = 50,
    seed: int = 0,
    pool: PhysicsPool | None = None,
    prompts: Sequence[str] | None = None,
    guidance: float = 0.0,
    slots: int | None = None,
    reward: Any = None,
) -> Measured:
    """Sample ``count`` scenes of ``num_steps`` denoiser evaluations and measure all of them. The same ``seed`` for two
    priors starts both from the same noise. ``prompts`` has one per scene; ``slots`` None takes as many as the prior was
    trained on; ``reward`` is that of the run, from :func:`rewards.process.run_reward`.
    """
    from scene_envs.physics import feasibility, make_ready

    raw = prior.sample(
        count, prompt=prompts, guidance=guidance, physics_guidance=0.0, num_steps=num_steps, slots=slots, seed=seed
    ).to("cpu")
    left_out: dict[str, str] = {}
    ready: ReadyResult | None = None
    counts = raw.counts.double()
    judged: dict[str, float] = {}
    rated: dict[str, float] = {}
    with leaving_out("feasible", left_out):
        feasible = feasibility(raw, pool=pool)
        ready = make_ready(raw, pool=pool)
        judged = {
            **_counted("feasible", raw, feasible.counts, feasible.valid),
            **_counted("ready", raw, ready.counts, ready.valid),
            "invalid_scenes": float((~(feasible.valid & ready.valid)).sum()),
        }
    context = RewardContext(None if prompts is None else tuple(prompts), pool)
    if reward is not None:
        with leaving_out("reward", left_out):
            scored = evaluate_reward(reward, raw, context)
            rated = {**_mean("reward", scored), "reward_invalid": float((~scored.is_valid).sum())}
    figures = {
        "scenes": float(count),
        "objects": float(counts.mean()),
        "objects_sem": _standard_error(counts),
        **rated,
        **judged,
        **realism(raw),
        **({} if prompts is None else _mean("prompt_match", PromptMatch()(raw, context))),
    }
    return Measured(figures, raw, ready.batch if ready else None, ready.ready if ready else None, left_out)


def _counted(name: str, batch: SceneBatch, counts: Tensor, valid: Tensor) -> dict[str, float]:
    """Mean and standard error of ``counts`` over valid scenes, and their share of the free objects there."""
    figures = per_scene_and_fraction(name, batch, counts, valid)
    return figures and {**figures, f"{name}_objects_sem": _standard_error(counts[valid].double())}


def _mean(name: str, output: RewardOutput) -> dict[str, float]:
    """Mean and standard error of a reward over its valid scenes; empty without any."""
    value = output.value[output.is_valid].double()
    return {name: float(value.mean()), f"{name}_sem": _standard_error(value)} if len(value) else {}


def _standard_error(values: Tensor) -> float:
    return float(values.std(unbiased=True) / len(values) ** 0.5) if len(values) > 1 else 0.0


def draw_scenes(shown: Mapping[str, tuple[SceneBatch, Tensor | None]], path: Path) -> Path:
    """Draw the first scenes of up to three batches, by the names in their captions, as a PNG: several have a column
    each. With (B, N) bool whether objects are ready, captions count these, and the other free objects are red.
    """
    from scene_envs.render import gallery, render

    count = _GALLERY if len(shown) == 1 else _GALLERY // 2
    drawn: list[list[tuple[NDArray[np.uint8], str]]] = []
    for name, (batch, is_ready) in shown.items():
        batch, free = batch[:count], batch[:count].is_free.cpu()
        red, texts = None, [f"{objects} objects" for objects in batch.counts.tolist()]
        if is_ready is not None:
            ready = is_ready[: len(batch)].cpu()
            counts = zip(ready.sum(dim=-1).tolist(), free.sum(dim=-1).tolist(), strict=True)
            red, texts = free & ~ready, [f"{good} of {total} ready" for good, total in counts]
        images = render(batch, width=_TILE[0], height=_TILE[1], highlight=red)
        prefix = f"{name}: " if name else ""
        drawn.append([(image, prefix + text) for image, text in zip(images, texts, strict=True)])
    tiles, captions = zip(*(tile for row in zip(*drawn, strict=True) for tile in row), strict=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    gallery(tiles, columns=_COLUMNS, captions=captions).quantize(192).save(path, optimize=True)
    return path


def write_report(path: Path, template: str, **content: Any) -> Path:
    """Write ``template``, a page of this package that extends ``report.html``, with its ``content``: one HTML file with
    styles and pictures inside, without script or link; text is escaped.
    """
    from markupsafe import Markup

    style = Markup(page_part("agents.utils", "report.css"))
    write_text(path, page_template("agents.post_training", template).render(style=style, **content))
    return path


def _draw_pictures(directory: Path, before: Measured, after: Measured) -> dict[str, Path]:
    """The pictures of the page, by name; those of samples are drawn into the run folder."""
    pictures = {"curve": directory / "curve.png"}
    for name, part in {"before": before, "after": after}.items():
        pictures[name] = draw_scenes({"": (part.raw, None)}, directory / f"{name}.png")
        if part.ready is not None:
            path = directory / f"{name}_ready.png"
            pictures[f"{name}_ready"] = draw_scenes({"": (part.ready, part.is_ready)}, path)
    for name in ("guard_within", "guard_beyond"):
        if (path := directory / f"{name}.safetensors").exists():
            pictures[name] = draw_scenes({"": (SceneBatch.load(path), None)}, directory / f"{name}.png")
    return pictures


def number_rows(columns: Mapping[str, Mapping[str, float]]) -> list[tuple[str, ...]]:
    """Rows of a table with a column of figures per prior; figures that one of them lacks are left out."""
    names = [name for name in _LABELS if all(name in figures for figures in columns.values())]
    rows = [(_LABELS[name], *(_number(figures, name) for figures in columns.values())) for name in names]
    return [("", *columns), *rows]


def rows_with_change(before: Mapping[str, float], after: Mapping[str, float]) -> list[tuple[str, ...]]:
    """The rows of a table of figures before and after a training, with the relative change in the last column."""
    head, *rows = number_rows({"before": before, "after": after})
    changes = [_relative(before[name], after[name]) for name in _LABELS if name in before and name in after]
    texts = ["" if change is None else f"{change:+.0%}" for change in changes]
    return [(*head, "change"), *((*row, text) for row, text in zip(rows, texts, strict=True))]


def _number(figures: Mapping[str, float], name: str) -> str:
    value = figures[name]
    if name.endswith("_fraction"):
        return f"{value:.1%}"
    error = figures.get(name + "_sem")
    return f"{value:.2f}" if error is None else f"{value:.2f} ± {error:.2f}"


def _relative(before: float, after: float | None) -> float | None:
    """The relative change; None if ``before`` is not positive."""
    return None if after is None or before <= 0 else after / before - 1.0
