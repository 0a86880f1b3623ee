"""Functions that several commands share: sampling, scoring, making ready, drawing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from agents.cli.run_folder import Run
from agents.configuration.composition import DrawKeys
from scene_envs.arrays import resolve_device

if TYPE_CHECKING:
    from agents.priors.prior import ScenePrior
    from scene_envs.physics import PhysicsPool
    from scene_envs.scene import SceneBatch


def load_prior(settings: Any) -> ScenePrior:
    """The prior that the keys ``prior``, ``device`` and ``precision`` name."""
    from agents.priors.prior import ScenePrior

    return ScenePrior.load(settings.prior).to(resolve_device(settings.device)).with_precision(settings.precision)


def draw(prior: ScenePrior, settings: DrawKeys, count: int, **keys: Any) -> SceneBatch:
    """Samples of a prior, on the CPU; ``keys`` are further arguments of its method, or take the place of settings."""
    own = {"num_steps": settings.num_steps, "physics_guidance": settings.physics_guidance, "seed": settings.seed}
    return prior.sample(count, **(own | keys)).to("cpu")


def object_counts(batch: SceneBatch) -> dict[str, float]:
    """Mean, least and greatest number of objects of a scene."""
    counts = batch.counts
    return {"mean": float(counts.double().mean()), "min": int(counts.min()), "max": int(counts.max())}


def reward_figures(
    reward: Any, batch: SceneBatch, prompt: str | None, pool: PhysicsPool | None, run: Run
) -> dict[str, Any]:
    """Mean, spread and validity of a reward over scenes made for ``prompt``, and the means of its terms."""
    from rewards import RewardContext, evaluate_reward, reward_name

    output = evaluate_reward(
        reward, batch, RewardContext(None if prompt is None else (prompt,) * len(batch), pool), strict=True
    )
    valid = output.is_valid
    value = output.value[valid].double()
    figures: dict[str, Any] = {"name": reward_name(reward), "valid": int(valid.sum())}
    if len(value):
        figures |= {"mean": float(value.mean()), "std": float(value.std(unbiased=False)), "max": float(value.max())}
        figures["terms"] = {name: float(term[valid].double().mean()) for name, term in output.terms.items()}
        run.say(f"{figures['name']}: {figures['mean']:.4g} on average, {figures['max']:.4g} at best")
    return figures


def make_ready(
    batch: SceneBatch, pictures: int, pool: PhysicsPool | None, run: Run
) -> tuple[SceneBatch, dict[str, Any]]:
    """Project and settle the scenes into ``ready.safetensors`` and ``ready.png``; returns them, and the figures."""
    from scene_envs import physics

    result = physics.make_ready(batch, pool=pool)
    result.batch.save(run.directory / "ready.safetensors")
    valid = result.valid
    free = int(batch.is_free[valid].sum())
    figures: dict[str, Any] = {"valid": int(valid.sum())}
    if bool(valid.any()):
        counts = result.counts[valid]
        figures |= {"mean": float(counts.double().mean()), "fraction": float(counts.sum()) / max(free, 1)}
        run.say(
            f"simulation-ready: {figures['mean']:.1f} objects per scene, {figures['fraction']:.0%} of the free ones"
        )
    captions = [
        f"{int(ready)} of {int(total)} ready"
        for ready, total in zip(result.counts, batch.is_free.sum(dim=-1), strict=True)
    ]
    draw_scenes(result.batch, pictures, run, "ready.png", captions)
    return result.batch, figures


def draw_scenes(batch: SceneBatch, count: int, run: Run, name: str, captions: list[str] | None = None) -> None:
    """A gallery of the first ``count`` scenes."""
    from scene_envs.render import gallery, render

    if count > 0 and not batch.scene_type.has_geometry:
        run.log(f"no {name}: the assets of {batch.scene_type.name!r} have no geometry here")
    if count < 1 or not batch.scene_type.has_geometry:
        return
    shown = batch[: min(count, len(batch))]
    if captions is None:
        captions = [f"{int(objects)} objects" for objects in shown.counts]
    images = render(shown, width=400, height=300)
    gallery(list(images), columns=4, captions=captions[: len(shown)]).save(run.directory / name)
