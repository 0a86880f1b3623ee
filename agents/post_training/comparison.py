"""Comparison of a prior before and after post-training: measures on fresh samples, pictures, report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from agents.post_training.guard_report import guard_sections, guard_verdict
from agents.post_training.hold_report import hold_sections
from agents.post_training.report import Page, Picture, Section, Tile, write_report
from agents.post_training.run_files import write_metrics
from agents.post_training.trainer import PostTrainResult
from agents.priors.prior import ScenePrior
from rewards import PromptMatch, RewardContext, RewardOutput, evaluate_reward, reward_label
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool

_GALLERY, _COLUMNS, _TILE = 12, 3, (400, 300)


@dataclass(frozen=True)
class Measured:
    """Fresh samples of a prior and their measured figures.

    Attributes:
        figures: ``objects`` (mean count, welded included), ``objects_sem`` (its standard error), ``feasible_objects``
            (free, raw), ``feasible_fraction`` of free objects, ``ready_objects`` (free, after projection and
            settling, feasible and in the workspace), ``ready_objects_sem``, ``ready_fraction``, ``scenes``,
            ``reward`` (mean of the trained reward), ``reward_sem``, ``reward_invalid`` (scenes it could not score),
            ``prompt_match`` (with prompts: the reward of that name), ``prompt_match_sem``,
            ``invalid_scenes`` (physics failed: left out of feasible and ready figures), and the cheap realism figures.
        raw: raw samples.
        ready: the samples after projection and settling.
        is_ready: (B, N) bool, simulation-ready objects of ``ready``.
    """

    figures: dict[str, float]
    raw: SceneBatch
    ready: SceneBatch
    is_ready: Tensor


def measure_prior(
    prior: ScenePrior,
    count: int,
    *,
    num_steps: int = 50,
    seed: int = 0,
    pool: PhysicsPool | None = None,
    prompts: Sequence[str] | None = None,
    guidance: float = 0.0,
    claim_guidance: float = 0.0,
    slots: int | None = None,
    reward: Any = None,
) -> Measured:
    """Sample ``count`` scenes and measure all of them.

    Args:
        prior: prior to measure.
        count: number of scenes.
        num_steps: denoiser evaluations per scene.
        seed: seed of the samples; the same seed for two priors starts both from the same noise.
        pool: physics workers.
        prompts: one prompt per scene, with which the samples are compared; None for none.
        guidance: weight of classifier-free guidance.
        claim_guidance: strength of claim guidance.
        slots: per sample; None means as trained.
        reward: reward that the run trains with, as :func:`rewards.process.run_reward` gives it; None measures none.
    """
    from agents.post_training.guard import realism
    from scene_envs.physics import feasibility, make_ready

    raw = prior.sample(
        count, prompt=prompts, guidance=guidance, claim_guidance=claim_guidance, physics_guidance=0.0,
        num_steps=num_steps, slots=slots, seed=seed,
    )  # fmt: skip
    feasible = feasibility(raw, pool=pool)
    ready = make_ready(raw, pool=pool)
    counts = raw.counts.double()
    free = raw.is_free.sum(dim=-1).double()
    figures = {
        "scenes": float(count),
        "objects": float(counts.mean()),
        "objects_sem": _standard_error(counts),
        **({} if reward is None else _reward_figures(raw, reward, prompts, pool)),
        **_counted("feasible", feasible.counts, feasible.valid, free),
        **_counted("ready", ready.counts, ready.valid, free),
        "invalid_scenes": float((~(feasible.valid & ready.valid)).sum()),
        **realism(raw),
        **({} if prompts is None else _mean("prompt_match", PromptMatch()(raw, RewardContext(prompts=tuple(prompts))))),
    }
    return Measured(figures, raw, ready.batch, ready.ready)


def write_comparison(
    result: PostTrainResult, before: Measured, after: Measured, *, title: str, extra: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Write ``before.png``, ``after.png``, ``report.html`` and ``metrics.json`` to the run folder.

    Args:
        result: result of the run.
        before: samples of the base prior.
        after: samples of the post-trained prior.
        title: heading of the page.
        extra: more entries for ``metrics.json``.

    Returns:
        Content of ``metrics.json``: the run's metrics, ``before``, ``after`` and ``change`` (relative).
    """
    directory, settings = result.directory, result.config.plain()
    names = [name for name in ("reward", "objects", "feasible_objects", "ready_objects") if name in before.figures]
    change = {name: _relative(before.figures[name], after.figures.get(name)) for name in names}
    metrics = {"before": before.figures, "after": after.figures, "change": change, **result.metrics, **(extra or {})}
    pictures = {
        "before": draw_gallery(before.raw, directory / "before.png"),
        "after": draw_gallery(after.raw, directory / "after.png"),
        "before_ready": draw_gallery(before.ready, directory / "before_ready.png", before.is_ready),
        "after_ready": draw_gallery(after.ready, directory / "after_ready.png", after.is_ready),
    }
    for name in ("guard_within", "guard_beyond"):
        if (path := directory / f"{name}.safetensors").exists():
            pictures[name] = draw_gallery(SceneBatch.load(path), directory / f"{name}.png")
    held = hold_sections(metrics.get("hold"), result.history, directory / "hold.png")
    write_report(directory / "report.html", _page(title, metrics, directory / "curve.png", pictures, settings, held))
    write_metrics(directory, metrics)
    return metrics


def draw_gallery(batch: SceneBatch, path: Path, is_ready: Tensor | None = None) -> Path:
    """Draw the first scenes of ``batch`` with their counts as a PNG.

    Args:
        batch: scenes to draw.
        path: image file to write.
        is_ready: (B, N) bool; if given, captions count these objects, and the other free objects are red.
    """
    images, captions = _drawn(batch, is_ready, _GALLERY)
    return _save_gallery(images, captions, path)


def draw_side_by_side(measured: Mapping[str, Measured], path: Path, *, ready: bool = False) -> Path:
    """Draw the first scenes of several priors as a PNG: a row per scene, a column per prior.

    Args:
        measured: samples of each prior from the same noise, by the name in the captions; three fit the page.
        path: image file to write.
        ready: whether to show the scenes after projection and settling, with objects that are not ready in red.
    """
    drawn = [
        _drawn(part.ready if ready else part.raw, part.is_ready if ready else None, _GALLERY // 2)
        for part in measured.values()
    ]
    images = [image for row in zip(*(images for images, _ in drawn), strict=True) for image in row]
    texts = zip(*(captions for _, captions in drawn), strict=True)
    captions = [f"{name}: {text}" for row in texts for name, text in zip(measured, row, strict=True)]
    return _save_gallery(images, captions, path)


def _drawn(batch: SceneBatch, is_ready: Tensor | None, count: int) -> tuple[NDArray[np.uint8], list[str]]:
    """Images (b, H, W, 3) of the first ``count`` scenes, and a caption for each."""
    from scene_envs.render import render

    shown = batch[:count]
    width, height = _TILE
    if is_ready is None:
        return render(shown, width=width, height=height), [f"{count} objects" for count in shown.counts.tolist()]
    ready = is_ready[: len(shown)].cpu()
    images = render(shown, width=width, height=height, highlight=shown.is_free.cpu() & ~ready)
    free = shown.is_free.sum(dim=-1).tolist()
    return images, [f"{good} of {total} ready" for good, total in zip(ready.sum(dim=-1).tolist(), free, strict=True)]


def _save_gallery(images: Sequence[NDArray[np.uint8]] | NDArray[np.uint8], captions: list[str], path: Path) -> Path:
    from scene_envs.render import gallery

    path.parent.mkdir(parents=True, exist_ok=True)
    gallery(images, columns=_COLUMNS, captions=captions).quantize(192).save(path, optimize=True)
    return path


def _page(
    title: str,
    metrics: Mapping[str, Any],
    curve: Path,
    pictures: Mapping[str, Path],
    settings: Mapping[str, Any],
    held: Sequence[Section],
) -> Page:
    reward = reward_label(settings["reward"])
    algorithm = settings["algorithm"]["name"].upper().replace("_", "-")
    before, after, guard = metrics["before"], metrics["after"], metrics["guard"]
    count = int(before["scenes"])
    lead = (
        f"{metrics['iterations']} iterations of {algorithm} on {reward}, with the pretraining loss on real scenes as "
        f"regularisation. All numbers are means over {count} fresh, seeded samples of each prior; none was selected."
    )
    tiles = [
        _tile(f"reward: {reward}", "reward", before, after, "no scene could be scored"),
        _tile("objects per scene", "objects", before, after),
        _tile("feasible as sampled", "feasible_objects", before, after),
        _tile("simulation-ready", "ready_objects", before, after),
        Tile("held-out loss", f"{guard['ratio']:.2f}×", f"of the base prior; limit {guard['limit']:g}×"),
    ]
    over = guard["over_optimised_from"]
    verdict = f"{guard_verdict(guard)} The prior kept is that of iteration {guard['best_iteration']}."
    if lost := metrics["reward"].get("invalid_scenes"):
        verdict += f" The reward could not score {lost} of the scenes; log.txt says why."
    caption = f"Mean {reward} of each batch, and the guard." + ("" if over is None else " Shaded: over-optimised.")
    sections = [
        Section("The curve", verdict, [Picture(curve, caption)]),
        *held,
        *guard_sections(guard, pictures),
        Section(
            "As sampled",
            "The first samples of each prior from the same noise, untouched.",
            [Picture(pictures["before"], "Before"), Picture(pictures["after"], "After")],
        ),
        Section(
            "Simulation-ready",
            "The same samples, projected out of penetration and settled. Red objects are not ready: they still move, "
            "penetrate, or have left the workspace.",
            [Picture(pictures["before_ready"], "Before"), Picture(pictures["after_ready"], "After")],
        ),
        Section("Numbers", table=_with_change(before, after)),
    ]
    return Page(title, lead, tiles, sections, settings)


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


def number_rows(columns: Mapping[str, Mapping[str, float]]) -> list[tuple[str, ...]]:
    """Rows of a table with a column of figures per prior; figures that one of them lacks are left out."""
    names = [name for name in _LABELS if all(name in figures for figures in columns.values())]
    rows = [(_LABELS[name], *(_number(figures, name) for figures in columns.values())) for name in names]
    return [("", *columns), *rows]


def _with_change(before: Mapping[str, float], after: Mapping[str, float]) -> list[tuple[str, ...]]:
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


def _tile(
    label: str, name: str, before: Mapping[str, float], after: Mapping[str, float], failure: str = "physics failed"
) -> Tile:
    if name not in before or name not in after:
        return Tile(label, "–", failure)
    change = _relative(before[name], after[name])
    digits = ".1f" if max(abs(before[name]), abs(after[name])) >= 10 or name != "reward" else ".3g"
    note = f"from {before[name]:{digits}}" + ("" if change is None else f", {change:+.0%}")
    return Tile(label, f"{after[name]:{digits}}", note)


def _relative(before: float, after: float | None) -> float | None:
    """The relative change; None if ``before`` is not positive."""
    return None if after is None or before <= 0 else after / before - 1.0


def _counted(name: str, counts: Tensor, valid: Tensor, free: Tensor) -> dict[str, float]:
    """Mean and standard error of ``counts`` over valid scenes, and their share of the free objects there."""
    if not bool(valid.any()):
        return {}
    taken = counts[valid].double()
    share = float(taken.sum() / free[valid].sum()) if float(free[valid].sum()) else 0.0
    return {
        f"{name}_objects": float(taken.mean()),
        f"{name}_objects_sem": _standard_error(taken),
        f"{name}_fraction": share,
    }


def _reward_figures(
    batch: SceneBatch, reward: Any, prompts: Sequence[str] | None, pool: PhysicsPool | None
) -> dict[str, float]:
    """Mean of ``reward`` over the scenes that it can score, and the number of the others."""
    output = evaluate_reward(reward, batch, RewardContext(None if prompts is None else tuple(prompts), pool))
    return {**_mean("reward", output), "reward_invalid": float((~output.is_valid).sum())}


def _mean(name: str, output: RewardOutput) -> dict[str, float]:
    """Mean and standard error of a reward over its valid scenes; empty without any."""
    value = output.value[output.is_valid].double()
    return {name: float(value.mean()), f"{name}_sem": _standard_error(value)} if len(value) else {}


def _standard_error(values: Tensor) -> float:
    return float(values.std(unbiased=True) / len(values) ** 0.5) if len(values) > 1 else 0.0
