"""``scene-envs import-checkpoint``."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any

from agents.cli.run_folder import Run
from agents.configuration.composition import DeviceKeys, named
from scene_envs.arrays import resolve_device
from scene_envs.errors import Count, InvalidInputError, Natural, Seed

POSITIONAL = ("checkpoint", "metadata")
"""Words without ``=`` fill these keys, in this order."""


@dataclass
class ImportCheckpointConfig(DeviceKeys):
    """A prior from a checkpoint of the paper's authors: scene-envs import-checkpoint FILE metadata.json.

    Attributes:
        checkpoint: the Lightning .ckpt of a mixed Flux model; the first word without =.
        metadata: the metadata.json of its training data; the second word without =.
        scene: scene type whose assets the model paths name; empty makes a scene type from the metadata.
        aliases: asset name for each model path or its stem, as in {their_cup: teacup}; null for none.
        text_encoder: folder or hub name of the BERT with which the checkpoint reads prompts. Empty takes BERT-base if
            it is on this machine; otherwise the prior reads no prompts.
        count: number of scenes to sample as a trial; 0 for none.
        num_steps: denoising steps of the trial.
        seed: seed of the trial.
        output: folder for prior/ and, with a trial, scenes.safetensors.
    """

    checkpoint: str = ""
    metadata: str = ""
    scene: Any = named("", "scene")
    aliases: dict[str, str] = field(default_factory=dict)
    text_encoder: str = ""
    count: Natural = 4
    num_steps: Count = 50
    seed: Seed = 0
    output: str = ""


def check(settings: ImportCheckpointConfig) -> None:
    """Refuse files that are not there."""
    if not settings.checkpoint or not settings.metadata:
        raise InvalidInputError("name the two files: scene-envs import-checkpoint FILE metadata.json")
    for path in (settings.checkpoint, settings.metadata):
        if not os.path.isfile(path):
            raise InvalidInputError(f"{path[:200]!r} is no file; name one that is there")


def run(settings: ImportCheckpointConfig, run: Run) -> None:
    """Read the checkpoint, save the prior and sample a trial."""
    from agents.priors.checkpoint_import import import_checkpoint

    prior = import_checkpoint(
        settings.checkpoint,
        settings.metadata,
        scene=settings.scene or None,
        aliases=settings.aliases or {},
        text_encoder=settings.text_encoder,
    )
    prior.save(run.directory / "prior")
    parameters = sum(tensor.numel() for tensor in prior.weights().values())
    run.say(f"{parameters / 1e6:.1f} M parameters, {prior.scene_type.num_assets} assets, {prior.config.slots} slots")
    run.say("it reads prompts" if prior.conditional else "it is sampled without prompts")
    metrics = {"parameters": parameters, "trained_steps": prior.card["trained_steps"]}
    if settings.count > 0:
        prior = prior.to(resolve_device(settings.device))
        batch = prior.sample(settings.count, num_steps=settings.num_steps, seed=settings.seed).to("cpu")
        batch.save(run.directory / "scenes.safetensors")
        metrics["mean_objects"] = float(batch.counts.double().mean())
        run.say(f"a trial of {len(batch)} scenes has {metrics['mean_objects']:.1f} objects on average")
    run.write_metrics(metrics)
    run.say(f"sample it: scene-envs sample prior={run.directory}")
