"""Keys, input and output that ``scene-envs complete`` and ``rearrange`` share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any

from agents.cli.commands.scenes import draw, draw_scenes, load_prior
from agents.cli.run_folder import Run
from agents.configuration.composition import DrawKeys, PromptKeys
from scene_envs.errors import Count, InvalidInputError, Natural, at_least

if TYPE_CHECKING:
    from agents.priors.prior import ScenePrior
    from scene_envs.scene import SceneBatch


_FRESH = 12
"""Fresh samples when no number is given."""
_AT_ONCE = 64
"""Scenes that are denoised together."""


@dataclass
class InpaintingConfig(PromptKeys, DrawKeys):
    """Scenes that a prior completes or rearranges.

    Attributes:
        scenes: a scene file, a folder of scene files, the folder of a sample or project run (its simulation-ready
            scenes if it has any), or a dataset; empty takes fresh samples of ``prior``.
        prior: a shipped name, or the folder of a prior or a run; empty means the shipped prior of the scene type.
        count: number of scenes, from the first; null for all, or for 12 fresh samples.
        pictures: number of scenes in the galleries; 0 draws none.
        output: folder for scenes.safetensors, before.png and gallery.png.
    """

    scenes: str = ""
    prior: str = ""
    count: Count | None = None
    pictures: Natural = 12
    output: str = ""

    def in_parts(self, batch: SceneBatch, change: Callable[..., SceneBatch], **keys: Any) -> SceneBatch:
        """The scenes as ``change`` makes them from a part and the keys of sampling; parts bound the memory."""
        names = ("prompt", "guidance", "claim_guidance", "physics_guidance", "num_steps")
        keys |= {name: getattr(self, name) for name in names}
        starts = range(0, len(batch), _AT_ONCE)
        parts = [change(batch[first : first + _AT_ONCE], seed=self.seed + first, **keys).to("cpu") for first in starts]
        return parts[0].concatenate(parts)


def check(settings: InpaintingConfig) -> None:
    """Refuse settings that name neither scenes nor a prior."""
    if not settings.scenes and not settings.prior:
        raise InvalidInputError("name a scene file, run or dataset, as in scenes=runs/mine, or a prior= to sample from")


def load_prior_and_scenes(command: str, settings: InpaintingConfig) -> tuple[ScenePrior, SceneBatch]:
    """The prior and the scenes that a command works on."""
    if not settings.scenes:
        from agents.utils.checkpoints import derived_seed

        prior, count = load_prior(settings), _FRESH if settings.count is None else settings.count
        noise = derived_seed(settings.seed, 1)  # with the same noise, a scene would be rearranged into itself
        return prior, draw(prior, settings, count, seed=noise)
    from scene_envs.datasets import load_scenes

    batch = load_scenes(Path(settings.scenes), settings.count)
    if not len(batch):
        raise InvalidInputError(f"{command}: scenes={settings.scenes!r} holds no scene")
    prior = load_prior(replace(settings, prior=settings.prior or batch.scene_type.name))
    if prior.scene_type.name != batch.scene_type.name:
        raise InvalidInputError(
            f"{command}: the prior makes scenes of {prior.scene_type.name!r}, the file holds {batch.scene_type.name!r}"
        )
    return prior, batch


def save_scenes(before: SceneBatch, after: SceneBatch, pictures: int, run: Run, figures: dict[str, float]) -> None:
    """Write the scenes, both galleries and the metrics, with the shares of free objects that are feasible."""
    from agents.evaluation.physics_figures import leaving_out, per_scene_and_fraction
    from scene_envs.physics import feasibility

    after.save(run.directory / "scenes.safetensors")
    with leaving_out("feasible", {}):
        for name, batch in (("feasible_before", before), ("feasible", after)) if before.scene_type.has_geometry else ():
            verdict = feasibility(batch)
            figures |= per_scene_and_fraction(name, batch, verdict.counts, verdict.valid)
            if (share := figures.get(f"{name}_fraction")) is not None:
                run.say(f"{name.replace('_', ' ')}: {share:.0%} of the free objects")
    draw_scenes(before, pictures, run, "before.png")
    draw_scenes(after, pictures, run, "gallery.png")
    run.write_metrics({"scenes": len(after), **figures})
    run.say(f"written to {run.directory}")


@dataclass
class CompleteConfig(InpaintingConfig):
    """Completion of scenes; their objects stay bit-identical.

    Attributes:
        slots: slots of the result; null keeps the number of the scenes.
        fill: most objects to add to a scene; null for as many as there are empty slots.
    """

    slots: Count | None = None
    fill: Annotated[int, at_least(0)] | None = None


def run_complete(settings: CompleteConfig, run: Run) -> None:
    """Fill the empty slots."""
    prior, batch = load_prior_and_scenes("complete", settings)
    filled = settings.in_parts(batch, prior.complete, slots=settings.slots, fill=settings.fill)
    added = float((filled.counts - batch.counts).double().mean())
    run.say(f"{len(batch)} scenes, {added:.1f} objects added on average")
    save_scenes(batch, filled, settings.pictures, run, {"added": added})


def run_rearrange(settings: InpaintingConfig, run: Run) -> None:
    """Give the free objects new poses; welded objects stay."""
    prior, batch = load_prior_and_scenes("rearrange", settings)
    moved = settings.in_parts(batch, prior.rearrange)
    distance = (moved.translations - batch.translations).norm(dim=-1)[batch.is_free]
    figures = {"mean_distance_m": float(distance.double().mean()) if len(distance) else 0.0}
    run.say(f"{len(batch)} scenes, objects moved by {figures['mean_distance_m']:.3f} m on average")
    save_scenes(batch, moved, settings.pictures, run, figures)


complete = SimpleNamespace(run=run_complete, check=check)
rearrange = SimpleNamespace(run=run_rearrange, check=check)
