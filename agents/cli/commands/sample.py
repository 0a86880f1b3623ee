"""``scene-envs sample``."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

from agents.cli.commands.export import export_scenes, keep_verified
from agents.cli.commands.scenes import draw, draw_scenes, load_prior, make_ready, object_counts, reward_figures
from agents.cli.run_folder import Run
from agents.configuration.composition import DrawKeys, OutputKeys, PromptKeys, RewardLimitKeys, SamplingKeys, named
from scene_envs.errors import Count, InvalidInputError, OneOf, at_least

if TYPE_CHECKING:
    from scene_envs.scene import SceneBatch
    from scene_envs.scene_types import SceneType


_SAMPLED = ("prompt", "guidance", "claim_guidance", "eta", "slots", "batch_size")


@dataclass
class SampleConfig(PromptKeys, SamplingKeys, DrawKeys, RewardLimitKeys, OutputKeys):
    """Scenes from a prior.

    Attributes:
        prior: a shipped name, or the folder of a prior or a run.
        count: number of scenes to draw.
        eta: scale of the noise of the Gaussian steps: 1 for the ancestral chain, 0 for a deterministic chain (DDIM).
        union: objects in a scene of a prior of several scene types: one_type (only objects of one type) or any.
        reward: reward that scores the samples for metrics.json; null for none.
        project: also make the samples simulation-ready (project out of penetration, then settle).
        export: formats of the exported scenes, as drake or [drake, mjcf]; null for none. With project=true the
            simulation-ready scenes are exported. See scene-envs export.
        randomization: YAML file with distributions of mass, friction, color, texture, light and camera for the export;
            empty for none.
        verify: export only scenes that all installed engines and simulators find ready; needs project=true and export=.
        output: folder for scenes.safetensors and gallery.png, with project=true also ready.safetensors and ready.png;
            exported scenes are in its folder export/.
    """

    prior: str = "dimsum_table"
    count: Count = 16
    eta: Annotated[float, at_least(0)] = 1.0
    union: Annotated[str, OneOf(("one_type", "any"))] = "one_type"
    reward: Any = named("feasible_objects", "reward")
    project: bool = False
    export: Any = None
    randomization: str = ""
    verify: bool = False


def check(settings: SampleConfig) -> None:
    """Refuse impossible settings before a prior is loaded."""
    from scene_envs.export.formats import resolve_formats
    from scene_envs.export.randomization import read_randomization

    if settings.export is not None:
        resolve_formats(settings.export)
    if read_randomization(settings.randomization) and settings.export is None:
        raise InvalidInputError("randomization= changes exported scenes; add export=, as export=mjcf")
    if settings.verify and not (settings.project and settings.export is not None):
        raise InvalidInputError("verify=true judges exported scenes; add project=true and export=, as export=mjcf")


def run(settings: SampleConfig, run: Run) -> None:
    """Draw, score, save and picture the scenes."""
    from agents.evaluation.physics_figures import leaving_out
    from agents.priors.guidance import physics_strength
    from rewards.process import close_reward
    from scene_envs.envs.scoring import RewardScorer
    from scene_envs.export.formats import resolve_formats
    from scene_envs.physics import make_pool

    formats = None if settings.export is None else resolve_formats(settings.export)
    reward = None
    if settings.reward is not None:
        reward = settings.running(settings.reward)
        RewardScorer(reward, prompted=settings.prompt is not None)  # refuses one that needs prompts
    prior = load_prior(settings).with_union(settings.union)
    if not prior.scene_type.has_geometry:
        settings = _without_geometry(settings, prior.scene_type, run)
        reward = None if settings.reward is None else reward
    strength = physics_strength(settings.physics_guidance, prior.config, prior.scene_type)
    started = time.perf_counter()
    batch = draw(
        prior, settings, settings.count, physics_guidance=strength, **{key: getattr(settings, key) for key in _SAMPLED}
    )
    seconds = time.perf_counter() - started
    guided = f", with physics_guidance={strength:g}" if strength else ""
    objects = object_counts(batch)
    run.say(f"{len(batch)} scenes in {seconds:.1f} s{guided}, {objects['mean']:.1f} objects each on average")
    batch.save(run.directory / "scenes.safetensors")
    metrics: dict[str, Any] = {
        "scenes": len(batch),
        "objects": objects,
        "sampling_seconds": round(seconds, 3),
        "physics_guidance": strength,
    }
    if settings.prompt:
        metrics |= _claims_followed(batch, settings, run)
    with make_pool(settings.workers, physics=settings.physics) as pool:
        if reward is not None:
            left_out: dict[str, str] = {}
            with leaving_out("reward", left_out):
                metrics["reward"] = reward_figures(reward, batch, settings.prompt, pool, run)
            if left_out:
                metrics["left_out"] = left_out
            close_reward(reward)
        draw_scenes(batch, settings.pictures, run, "gallery.png")
        if settings.project:
            batch, metrics["ready"] = make_ready(batch, settings.pictures, pool, run)
        keys = {"randomization": settings.randomization}
        if formats is not None:
            if settings.verify:
                batch = keep_verified(batch, formats, run, **keys)
                shutil.rmtree(run.directory / "export", ignore_errors=True)  # of this run, perhaps with other judges
            if len(batch):
                metrics["export"] = export_scenes(batch, formats, run.directory / "export", pool, run, **keys)
    run.write_metrics(metrics)
    run.say(f"written to {run.directory}")


def _claims_followed(batch: SceneBatch, settings: SampleConfig, run: Run) -> dict[str, Any]:
    """Shares of the claims of the prompt that hold, and of scenes in which all do; says them, or why there are none."""
    from rewards import PromptMatch, RewardContext

    try:
        output = PromptMatch(settings.prompt)(batch, RewardContext())
    except InvalidInputError as error:
        run.say(f"claims of the prompt not checked: {error}")
        return {}
    share, whole = (float(output.terms[name].mean()) for name in ("claims_hold", "all_claims_hold"))
    hint = "" if settings.claim_guidance or whole > 0.9 else "; claim_guidance=2 moves objects toward the claims"
    run.say(f"prompt: {share:.0%} of the claims hold, all of them in {whole:.0%} of the scenes{hint}")
    return {"prompt": {"claims_hold": share, "all_claims_hold": whole}}


def _without_geometry(settings: SampleConfig, scene_type: SceneType, run: Run) -> SampleConfig:
    """The settings for assets without models: pictures and the default reward are left out, physics is refused."""
    if settings.project or settings.export is not None:
        raise InvalidInputError(
            f"project=true and export= need the geometry of the assets, and those of {scene_type.name!r} have none "
            "here; import the checkpoint with scene= and aliases=, or leave both out"
        )
    run.say(f"the assets of {scene_type.name!r} have no geometry here: no pictures, and no reward that needs physics")
    return replace(settings, pictures=0, reward=None if settings.reward == SampleConfig.reward else settings.reward)
