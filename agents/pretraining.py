"""Pretraining a scene prior on a dataset: one loop, exact resume, logs and cards."""

from __future__ import annotations

import csv
import json
import logging
import math
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Generator, Tensor, nn

from agents.checkpoints import load_checkpoint, save_checkpoint
from agents.denoiser import PriorConfig
from agents.diffusion import Preconditioning
from agents.networks import FluxConfig
from agents.prior import ScenePrior
from scene_envs.errors import TrainingError
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import get_scene_type

logger = logging.getLogger(__name__)


@dataclass
class PretrainConfig:
    """One pretraining run.

    Attributes:
        scene: scene type.
        data: dataset directory of training scenes.
        heldout: dataset directory of held-out scenes; empty takes the last 2 % of ``data``.
        output: run directory; an interrupted run in it goes on where it stopped.
        iterations: optimiser steps.
        batch_size: scenes per step.
        learning_rate: peak learning rate.
        final_learning_rate: where the cosine ends, as a fraction of the peak.
        warmup: steps of linear warm-up.
        weight_decay: decoupled weight decay.
        clip: largest gradient norm.
        ema: decay of the weight average that is evaluated and saved.
        hidden: width of the network.
        depth: blocks of the network.
        heads: attention heads.
        prediction: what the network predicts (``karras``, ``epsilon``, ``x0``, ``v``).
        schedule: noise schedule (``karras``, ``linear``, ``cosine``).
        compile: compile the network with ``torch.compile`` (needs a C++ compiler on CPU).
        seed: of weights, batches and noise.
        log_every: steps between log rows.
        evaluate_every: steps between held-out evaluations.
        checkpoint_every: steps between checkpoints.
        device: torch device.
    """

    scene: str = "dimsum_table"
    data: str = "data/dimsum_table"
    heldout: str = ""
    output: str = "runs/pretrain"
    iterations: int = 5000
    batch_size: int = 128
    learning_rate: float = 1e-3
    final_learning_rate: float = 0.01
    warmup: int = 100
    weight_decay: float = 0.01
    clip: float = 1.0
    ema: float = 0.999
    hidden: int = 192
    depth: int = 6
    heads: int = 6
    prediction: str = "karras"
    schedule: str = "karras"
    compile: bool = False
    seed: int = 0
    log_every: int = 20
    evaluate_every: int = 250
    checkpoint_every: int = 250
    device: str = "cpu"


class WeightAverage:
    """Exponential moving average of a module's parameters, with a warm-up of the decay.

    >>> layer = nn.Linear(1, 1)
    >>> average = WeightAverage(layer, decay=0.5)
    >>> _ = average.update(layer)
    >>> bool((average.tensors["weight"] == layer.weight).all())
    True
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.decay = decay
        self.updates = 0
        self.tensors = {name: p.detach().clone() for name, p in module.named_parameters()}

    @torch.no_grad()
    def update(self, module: nn.Module) -> float:
        """Move towards ``module``; returns the decay that was used."""
        self.updates += 1
        decay = min(self.decay, self.updates / (self.updates + 10.0))
        for name, parameter in module.named_parameters():
            self.tensors[name].lerp_(parameter, 1.0 - decay)
        return decay

    @torch.no_grad()
    def copy_to(self, module: nn.Module) -> None:
        """Write the averages into ``module``."""
        for name, parameter in module.named_parameters():
            parameter.copy_(self.tensors[name])


def learning_rate_at(step: int, config: PretrainConfig) -> float:
    """Linear warm-up, then a cosine to ``final_learning_rate`` of the peak."""
    if step < config.warmup:
        return config.learning_rate * (step + 1) / config.warmup
    progress = (step - config.warmup) / max(1, config.iterations - config.warmup)
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))
    return config.learning_rate * (config.final_learning_rate + (1 - config.final_learning_rate) * cosine)


def build_prior(config: PretrainConfig, raw: Tensor, normalizer: Normalizer) -> ScenePrior:
    """A fresh prior whose preconditioning is fitted to the raw scenes (M, N, D)."""
    scene_type = get_scene_type(config.scene)
    network = FluxConfig(scene_type.features, config.hidden, config.depth, config.heads)
    prior_config = PriorConfig(config.scene, raw.shape[1], network, config.schedule, config.prediction)
    torch.manual_seed(config.seed)
    sample = normalizer.normalize(raw[:20_000])
    return ScenePrior(prior_config, normalizer, Preconditioning.fit(sample[:, len(scene_type.fixed) :]))


@torch.no_grad()
def heldout_loss(prior: ScenePrior, x0: Tensor, seed: int = 1234, batch_size: int = 256) -> float:
    """Pretraining loss on normalised scenes ``x0`` with timesteps and noise fixed by ``seed``."""
    generator = Generator().manual_seed(seed)
    losses = [prior.pretraining_loss(chunk, generator, "none") for chunk in x0.split(batch_size)]
    return float(torch.cat(losses).mean())


class Pretrainer:
    """The state of one run: prior, average, optimisers, random generators, step.

    Args:
        config: the run.
        train: (M, N, D) normalised training scenes.
        heldout: (K, N, D) normalised held-out scenes.
        prior: the prior to train, in place.
    """

    def __init__(self, config: PretrainConfig, train: Tensor, heldout: Tensor, prior: ScenePrior) -> None:
        self.config = config
        self.train_data, self.heldout_data = train, heldout
        self.prior = prior.to(config.device).train()
        self.network = prior.denoiser.network
        self.average = WeightAverage(self.network, config.ema)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), betas=(0.9, 0.99), weight_decay=config.weight_decay
        )
        self.generator = Generator().manual_seed(config.seed)
        self.step = 0
        self.seconds = 0.0
        self.directory = Path(config.output)
        self.evaluations: list[dict[str, float]] = []

    @property
    def checkpoint_path(self) -> Path:
        """Where the resumable state lives."""
        return self.directory / "checkpoint.pt"

    def run(self) -> ScenePrior:
        """Train to ``config.iterations`` and return the averaged prior; writes it to ``output/prior``."""
        self.directory.mkdir(parents=True, exist_ok=True)
        if self.checkpoint_path.exists():
            self._load()
        network = self.network
        if self.config.compile:
            self.prior.denoiser.network = torch.compile(network)  # type: ignore[assignment]
        for row in self._steps():
            self._log(row)
        self.prior.denoiser.network = network
        with self._averaged():
            self.prior.fit_residual(self.heldout_data[:512].to(self.config.device))
        return self.save_prior()

    def _steps(self) -> Iterator[dict[str, float]]:
        config, started = self.config, time.perf_counter() - self.seconds
        running: list[float] = []
        while self.step < config.iterations:
            loss, norm = self._update()
            running.append(loss)
            self.step += 1
            self.seconds = time.perf_counter() - started
            last = self.step == config.iterations
            row: dict[str, float] = {}
            if self.step % config.evaluate_every == 0 or last:
                row["heldout"] = self._evaluate()
            if self.step % config.log_every == 0 or row:
                row |= {"step": self.step, "loss": sum(running) / len(running), "gradient_norm": norm}
                row |= {"learning_rate": learning_rate_at(self.step - 1, config), "seconds": round(self.seconds, 1)}
                running.clear()
                yield row
            if self.step % config.checkpoint_every == 0 or last:
                self._save()

    def _update(self) -> tuple[float, float]:
        config = self.config
        index = torch.randint(len(self.train_data), (config.batch_size,), generator=self.generator)
        loss = self.prior.pretraining_loss(self.train_data[index].to(config.device), self.generator)
        if not bool(torch.isfinite(loss)):
            raise TrainingError(
                f"the pretraining loss became {float(loss.detach())} at step {self.step}; the last good state is "
                f"{str(self.checkpoint_path)!r}: lower learning_rate (now {config.learning_rate}) and run again"
            )
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), config.clip)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate_at(self.step, config)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.average.update(self.network)
        return float(loss.detach()), float(norm)

    def _evaluate(self) -> float:
        with self._averaged():
            value = heldout_loss(self.prior, self.heldout_data.to(self.config.device))
        self.evaluations.append({"step": self.step, "heldout": value})
        return value

    def _averaged(self) -> _Swapped:
        return _Swapped(self.network, self.average)

    # -- files ----------------------------------------------------------------------------------

    def _save(self) -> None:
        save_checkpoint(
            self.checkpoint_path,
            {
                "config": asdict(self.config),
                "network": self.network.state_dict(),
                "average": self.average.tensors,
                "average_updates": self.average.updates,
                "optimizer": self.optimizer.state_dict(),
                "generator": self.generator.get_state(),
                "step": self.step,
                "seconds": self.seconds,
                "evaluations": self.evaluations,
            },
        )
        self.save_prior()

    def _load(self) -> None:
        state = load_checkpoint(self.checkpoint_path)
        self.network.load_state_dict(state["network"])
        self.average.tensors = state["average"]
        self.average.updates = state["average_updates"]
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        self.step, self.seconds = state["step"], state["seconds"]
        self.evaluations = state["evaluations"]
        logger.info("resumed at step %d", self.step)

    def save_prior(self) -> ScenePrior:
        """Write the averaged prior to ``output/prior`` and return the prior holding the averaged weights."""
        with self._averaged():
            self.prior.card = {
                "trained_steps": self.step,
                "batch_size": self.config.batch_size,
                "training_scenes": len(self.train_data),
                "seconds": round(self.seconds),
                "heldout_loss": self.evaluations[-1]["heldout"] if self.evaluations else None,
            }
            self._unwrapped_save()
            return ScenePrior.load(self.directory)

    def _unwrapped_save(self) -> None:
        wrapped = self.prior.denoiser.network
        self.prior.denoiser.network = self.network
        self.prior.save(self.directory / "prior")
        self.prior.denoiser.network = wrapped

    def _log(self, row: dict[str, float]) -> None:
        per_step = self.seconds / max(1, self.step)
        left = (self.config.iterations - self.step) * per_step
        text = "  ".join(f"{key} {value:.6g}" for key, value in row.items())
        logger.info("%s  left %.0f s", text, left)
        fields = ["step", "loss", "heldout", "gradient_norm", "learning_rate", "seconds"]
        path = self.directory / "log.csv"
        fresh = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, fields)
            if fresh:
                writer.writeheader()
            writer.writerow(row)


class _Swapped:
    """Context in which a network holds its averaged weights."""

    def __init__(self, network: nn.Module, average: WeightAverage) -> None:
        self.network, self.average = network, average

    def __enter__(self) -> None:
        self.saved = {name: p.detach().clone() for name, p in self.network.named_parameters()}
        self.average.copy_to(self.network)

    def __exit__(self, *_: object) -> None:
        with torch.no_grad():
            for name, parameter in self.network.named_parameters():
                parameter.copy_(self.saved[name])


def pretrain(config: PretrainConfig) -> dict[str, Any]:
    """Train a prior as ``config`` says; resumes a run found in ``config.output``.

    Returns:
        The numbers of ``metrics.json``, which is written beside the prior.
    """
    from scene_envs.datasets import SceneDataset

    dataset = SceneDataset.load(config.data)
    raw = dataset.tensor
    if config.heldout:
        heldout_raw = SceneDataset.load(config.heldout).tensor
    else:
        split = max(1, len(raw) // 50)
        raw, heldout_raw = raw[:-split], raw[-split:]
    prior = build_prior(config, raw, dataset.normalizer)
    heldout_raw = heldout_raw[:2048]
    trainer = Pretrainer(config, prior.normalizer.normalize(raw), prior.normalizer.normalize(heldout_raw), prior)
    trained = trainer.run()
    metrics = {**trained.card, "evaluations": trainer.evaluations, "config": asdict(config)}
    partial = trainer.directory / "metrics.json.partial"
    partial.write_text(json.dumps(metrics, indent=1))
    os.replace(partial, trainer.directory / "metrics.json")
    return metrics
