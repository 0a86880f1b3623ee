"""Pretraining a scene prior on a dataset: one loop, exact resume, logs and cards."""

from __future__ import annotations

import csv
import json
import logging
import math
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Generator, Tensor, nn

from agents.averaging import Averaged, WeightAverage
from agents.checkpoints import load_checkpoint, save_checkpoint
from agents.mixed_prior import MixedPrior
from agents.new_prior import build_prior
from agents.pretrain_config import PretrainConfig
from agents.prior import ScenePrior
from scene_envs.errors import TrainingError
from scene_envs.scene import SceneBatch

logger = logging.getLogger(__name__)


def learning_rate_at(step: int, config: PretrainConfig) -> float:
    """Linear warm-up, then a cosine to ``final_learning_rate`` of the peak."""
    if step < config.warmup:
        return config.learning_rate * (step + 1) / config.warmup
    progress = (step - config.warmup) / max(1, config.iterations - config.warmup)
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))
    return config.learning_rate * (config.final_learning_rate + (1 - config.final_learning_rate) * cosine)


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
        prompts: prompts of every training scene, for a prior that reads them.
    """

    def __init__(
        self,
        config: PretrainConfig,
        train: Tensor,
        heldout: Tensor,
        prior: ScenePrior,
        prompts: Sequence[Sequence[str]] = (),
    ) -> None:
        self.config = config
        self.train_data, self.heldout_data = train, heldout
        self.prior = prior.to(config.device).train()
        self.network: nn.Module = prior.denoiser
        self.prompts = prompts
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
        if self.config.compile:
            self.prior.denoiser.network.compile()
        for row in self._steps():
            self._log(row)
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
        x0 = self.train_data[index].to(config.device)
        loss = self.prior.pretraining_loss(x0, self.generator, **self._condition(index))
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

    def _condition(self, index: Tensor) -> dict[str, Any]:
        """The prompts of the scenes ``index``, one of each scene's, some withheld; nothing for other priors."""
        if not isinstance(self.prior, MixedPrior) or not self.prior.conditional:
            return {}
        choice = torch.rand(2, len(index), generator=self.generator).tolist()
        texts = [
            "" if dropped < self.config.prompt_dropout else group[int(pick * len(group))]
            for group, pick, dropped in zip((self.prompts[i] for i in index.tolist()), *choice, strict=True)
        ]
        return {"text": self.prior.encode_prompts(texts)}

    def _evaluate(self) -> float:
        with self._averaged():
            value = heldout_loss(self.prior, self.heldout_data.to(self.config.device))
        self.evaluations.append({"step": self.step, "heldout": value})
        return value

    def _averaged(self) -> Averaged:
        return Averaged(self.network, self.average)

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
            self.prior.save(self.directory / "prior")
            return ScenePrior.load(self.directory)

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


def pretrain(config: PretrainConfig) -> dict[str, Any]:
    """Train a prior as ``config`` says; resumes a run found in ``config.output``.

    Returns:
        The numbers of ``metrics.json``, which is written beside the prior.
    """
    from scene_envs.datasets import SceneDataset

    dataset = SceneDataset.load(config.data)
    raw, prompts = dataset.tensor, dataset.prompt_sets
    if config.heldout:
        heldout_raw = SceneDataset.load(config.heldout).tensor
    else:
        split = max(1, len(raw) // 50)
        raw, heldout_raw, prompts = raw[:-split], raw[-split:], prompts[:-split]
    prior = build_prior(config, raw, dataset.normalizer, prompts)

    def encode(scenes: Tensor) -> Tensor:
        return torch.cat([prior.encode(SceneBatch(part, prior.scene_type)) for part in scenes.split(10_000)])

    trainer = Pretrainer(config, encode(raw), encode(heldout_raw[:2048]), prior, prompts)
    trained = trainer.run()
    metrics = {**trained.card, "evaluations": trainer.evaluations, "config": asdict(config)}
    partial = trainer.directory / "metrics.json.partial"
    partial.write_text(json.dumps(metrics, indent=1))
    os.replace(partial, trainer.directory / "metrics.json")
    return metrics
