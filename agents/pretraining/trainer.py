"""Pretraining of a scene prior: the loop with exact resume and logs, and the warm-up of the text encoder."""

from __future__ import annotations

import csv
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor, nn
from torch.nn import functional as F
from torch.optim.lr_scheduler import LambdaLR

from agents.configuration.composition import MAX_GRADIENT_NORM, check_same_keys, config_text
from agents.configuration.prior_names import short_name
from agents.diffusion.reverse_steps import state_of
from agents.networks.flux_modules import Scene
from agents.networks.text import Text
from agents.pretraining.initial_prior import TrainingData, prepare
from agents.pretraining.optimizers import build_optimizer, learning_rate_at
from agents.pretraining.settings import WEIGHT_DECAY, PretrainConfig
from agents.priors.prior import ScenePrior
from agents.utils.checkpoints import check_tensors, derived_generator, load_checkpoint, save_checkpoint
from agents.utils.interrupts import Ending, finishing_steps
from agents.utils.loggers import RunLogger
from agents.utils.process_group import ProcessGroup, is_first_process
from agents.utils.weight_average import WeightAverage, averaged_weights
from scene_envs.arrays import resolve_device, within_memory
from scene_envs.errors import InvalidInputError, TrainingError
from scene_envs.files import claimed, sealed, write_json, write_text
from scene_envs.progress import Progress
from scene_envs.scene import POSE_FEATURES

logger = logging.getLogger(__name__)

FIELDS = ("step", "loss", "heldout", "gradient_norm", "learning_rate", "seconds")
"""Columns of ``log.csv``."""
_MAY_DIFFER = ("iterations", "output", "logger", "device", "recipe", "progress")
"""Keys that may change between a run and its continuation."""
_CHUNK, _RESIDUAL = 256, 512  # held-out scenes per pass, and those on which the residual error is measured
_UPDATES, _ROWS, _SLOTS = 4, 256, 32
"""Mean optimiser steps of a module per batch of scenes, states in each, and masked slots of a state that are kept."""
_PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
_RATE, _RISE = 3e-3, 0.2  # peak learning rate of the text warm-up, and the share of its steps in which it rises


@torch.no_grad()
def heldout_loss(prior: ScenePrior, x0: Tensor, prompts: Sequence[str] | None = None, seed: int = 1234) -> float:
    """Pretraining loss on normalised scenes ``x0`` (K, N, D), of ``prompts`` if given; ``seed`` fixes timesteps and
    noise.
    """
    generator, losses = Generator().manual_seed(seed), []
    for start in range(0, len(x0), _CHUNK):
        rows = slice(start, start + _CHUNK)
        text = None if prompts is None else prior.encode_prompts(prompts[rows])
        losses.append(prior.pretraining_loss(x0[rows], generator, "none", text=text))
    return float(torch.cat(losses).mean())


class Pretrainer:
    """The state of one run: prior, average, optimiser, step.

    The draws of a step depend only on (seed, step, part). The parts of a step are counted over all processes, so two
    processes take the same steps as one process with twice the parts. A killed run continues bit for bit.

    Args:
        config: configuration of the run.
        data: training scenes.
        heldout: (K, N, D) held-out scenes as the prior encodes them.
        prior: the prior to train, in place.
    """

    def __init__(self, config: PretrainConfig, data: TrainingData, heldout: Tensor, prior: ScenePrior) -> None:
        self.config = config
        self.data, self.heldout_data = data, heldout
        self.device = resolve_device(config.device)
        self.processes = ProcessGroup.join(str(self.device))
        self.parts = self.processes.size * config.optimizer.compute.accumulate
        if config.batch_size % self.parts:
            raise InvalidInputError(
                f"batch_size={config.batch_size} is not a multiple of {self.parts}, "
                f"the {self.processes.size} process(es) times accumulate={config.optimizer.compute.accumulate}"
            )
        self.prior = prior.to(self.device).train()
        self.network: nn.Module = prior.denoiser
        self.states: dict[str, Tensor] = {}  # on which a module alone is trained
        if config.module:
            if self.processes.size > 1:
                raise InvalidInputError(f"module={config.module} is trained by one process, not {self.processes.size}")
            self.network.requires_grad_(False).get_submodule(f"network.{config.module}").requires_grad_(True)
        settings = config.optimizer
        prior.denoiser.precision = _PRECISIONS[settings.compute.precision]
        self.average = WeightAverage(self.network, settings.ema)
        self.optimizer = build_optimizer(settings.name, self.network, WEIGHT_DECAY, config.text.vocabulary.lr_share)
        torch.set_float32_matmul_precision(settings.compute.matmul_precision)
        self.step = 0
        self.schedule = self._schedule()
        self.seconds = 0.0
        self.directory = config.directory
        self.checkpoint_path = self.directory / "checkpoint.pt"
        chosen = config.logger.name if self.processes.is_first else "csv"
        self.logger = RunLogger(chosen, self.directory)
        self.history: list[dict[str, float]] = []  # the rows of log.csv
        self._origin = _origin(config.prior, prior.card)

    @property
    def evaluations(self) -> list[dict[str, float]]:
        """Losses on held-out scenes, each with its step."""
        return [{"step": row["step"], "heldout": row["heldout"]} for row in self.history if "heldout" in row]

    def run(self) -> ScenePrior:
        """Train to ``config.iterations`` and return the averaged prior; writes it to ``output/prior``."""
        self.directory.mkdir(parents=True, exist_ok=True)
        if self.checkpoint_path.exists():
            self._load()
        elif not self.config.prior:
            self._warm_up_text()
        if self.config.optimizer.compute.compile:
            self.prior.denoiser.network.compile()
        if self.processes.is_first:
            (self.directory / "log.csv").unlink(missing_ok=True)  # it may hold rows beyond the checkpoint
            if self.history:
                self._write_rows(self.history)
        shown = self.config.progress if self.processes.is_first else "none"
        bar = Progress("pretraining", self.config.iterations, done=self.step, style=shown)
        with finishing_steps() as end, bar as progress:
            for row in self._steps(end):
                if self.processes.is_first:
                    self._show(progress, row)
                    self._write_rows([row])
                    logger.debug("%s", "  ".join(f"{key} {value:.6g}" for key, value in row.items()))
                    self.logger.log({key: value for key, value in row.items() if key != "step"}, self.step)
        self.logger.close()
        if self.config.module:  # poses are denoised as before
            return self.save_prior()
        if self.processes.is_first:
            logger.info("measuring the residual error at 40 noise levels, for the samplers")
        with averaged_weights(self.network, self.average):
            count = len(self.heldout_data)  # scenes of a union are sorted by type
            rows = torch.linspace(0, count - 1, min(_RESIDUAL, count)).long()
            self.prior.fit_residual(self.heldout_data[rows].to(self.device))
        self.prior.denoiser.precision = torch.float32
        return self.save_prior()

    def _warm_up_text(self) -> None:
        """Warm up the text encoder in the same way in every process, then take the weights of the first process."""
        steps = min(self.config.text.vocabulary.warmup, self.config.iterations)
        if warm_up_text(self.prior, self.data, steps, self.config.batch_size, self.config.seed) is not None:
            self.processes.share(self.network.parameters())
            self.average = WeightAverage(self.network, self.config.optimizer.ema)

    def _show(self, progress: Progress, row: Mapping[str, float]) -> None:
        step, total = int(row["step"]), self.config.iterations
        heldout = f"  held-out {self.evaluations[-1]['heldout']:.4g}" if self.evaluations else ""
        text = f"loss {row['loss']:.4g}{heldout}"
        left = row["seconds"] / max(1, step) * (total - step)
        progress.update(step, text, f"pretraining {step}/{total}  {text}  {left:.0f} s left")

    def _write_rows(self, rows: Sequence[Mapping[str, float]]) -> None:
        path = self.directory / "log.csv"
        header = [] if path.exists() else [{name: name for name in FIELDS}]
        with path.open("a", newline="") as file:
            csv.DictWriter(file, FIELDS).writerows([*header, *rows])

    def _steps(self, end: Ending) -> Iterator[dict[str, float]]:
        started, config = time.perf_counter() - self.seconds, self.config
        running: list[float] = []
        while self.step < config.iterations:
            loss, norm = self._update()
            running.append(loss)
            self.step += 1
            self.seconds = time.perf_counter() - started
            last = self.step == config.iterations
            row: dict[str, float] = {}
            if self.step % config.logger.evaluate_every == 0 or last:
                with averaged_weights(self.network, self.average):
                    row["heldout"] = heldout_loss(self.prior, self.heldout_data.to(self.device))
            if self.step % config.logger.log_every == 0 or row:
                row |= {"step": self.step, "loss": sum(running) / len(running), "gradient_norm": norm}
                row |= {"learning_rate": learning_rate_at(self.step - 1, config), "seconds": round(self.seconds, 1)}
                running.clear()
                self.history.append(row)
                yield row
            ending = self.processes.any(end.pending)
            if self.step % config.logger.checkpoint_every == 0 or last or ending:
                self._save()
            end(ending)

    def _update(self) -> tuple[float, float]:
        config = self.config
        if config.module:
            return self._module_update()
        total = torch.zeros((), device=self.device)
        for part in range(config.optimizer.compute.accumulate):
            generator = derived_generator(
                config.seed, self.step, self.processes.rank * config.optimizer.compute.accumulate + part
            )

            def part_loss(count: int, generator: Generator = generator) -> Tensor:
                loss = self._part_loss(count, generator) / self.parts
                loss.backward()  # type: ignore[no-untyped-call]
                return loss.detach()

            total += within_memory(part_loss, config.batch_size // self.parts, "batch_size / number of parts")
        value = float(self.processes.sum(total))
        if not math.isfinite(value):
            raise self._not_finite("loss", value)
        self.processes.sum_gradients(self.network.parameters())
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), MAX_GRADIENT_NORM)
        if not math.isfinite(float(norm)):
            raise self._not_finite("gradient norm", float(norm))
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.average.update(self.network)
        return value, float(norm)

    def _not_finite(self, what: str, value: float) -> TrainingError:
        kept = f"; the last good state is {str(self.checkpoint_path)!r}" if self.checkpoint_path.exists() else ""
        return TrainingError(
            f"the {what} became {value} at step {self.step}, and the update was not applied{kept}. Lower optimizer.lr "
            f"(now {self.config.optimizer.lr}) and give another output"
        )

    def _part_loss(self, count: int, generator: Generator) -> Tensor:
        """The loss of ``count`` scenes, each with one of its prompts, or without a prompt if it is withheld."""
        x0, text = self._drawn(count, generator)
        return self.prior.pretraining_loss(x0, generator, text=text)

    def _drawn(self, count: int, generator: Generator) -> tuple[Tensor, Text | None]:
        """``count`` scenes (count, N, D), and their text if the prior reads any."""
        reads = self.prior.conditional
        scenes, prompts = self.data.draw(count, generator, prompts=reads)
        x0 = scenes.to(self.device)
        if not reads:
            return x0, None
        choice = torch.rand(2, count, generator=generator).tolist()
        texts = [
            "" if dropped < self.config.text.dropout else group[int(pick * len(group))]
            for group, pick, dropped in zip(prompts, *choice, strict=True)
        ]
        return x0, self.prior.encode_prompts(texts)

    def _module_update(self) -> tuple[float, float]:
        """Keep the masked states of one more batch, and train the module on some of all that are kept."""
        generator = derived_generator(self.config.seed, self.step, 0)
        new = within_memory(lambda count: self._masked_states(count, generator), self.config.batch_size, "batch_size")
        self.states = {key: torch.cat([self.states[key], new[key]]) for key in new} if self.states else new
        module: Any = self.network.get_submodule(f"network.{self.config.module}")
        total, norm = 0.0, 0.0
        updates = math.ceil(2 * _UPDATES * (self.step + 1) / self.config.iterations)  # every state equally often
        for _ in range(updates):
            rows = torch.randint(len(self.states["inputs"]), (_ROWS,), generator=generator)
            inputs, logits, category, weight = (self.states[key][rows].to(self.device) for key in new)
            sums = logits.float() + module.from_inputs(inputs)
            losses = F.cross_entropy(sums.transpose(1, 2), category.long(), reduction="none")  # not of -100
            loss = (losses.sum(dim=1) * weight).mean()
            loss.backward()  # type: ignore[no-untyped-call]
            norm = float(nn.utils.clip_grad_norm_(module.parameters(), MAX_GRADIENT_NORM))
            total += float(loss.detach())
            if not math.isfinite(total + norm):
                raise self._not_finite("loss or gradient norm", total + norm)
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
        self.average.update(self.network)
        self.schedule.step()
        return total / updates, norm

    @torch.no_grad()
    def _masked_states(self, count: int, generator: Generator) -> dict[str, Tensor]:
        """Of ``count`` noised scenes, on the CPU: ``inputs`` (count, 2K + W) of count logits, ``logits`` (count, S, K)
        of the rest and ``category`` (count, S), -100 for none, of up to S masked slots, and ``weight`` (count,).
        Weighted sums over the slots bound the negative log-likelihood of a slot, nats.
        """
        prior: Any = self.prior
        network, (x0, text) = prior.denoiser.network, self._drawn(count, generator)
        masked = prior.categories.schedule.mask.cpu()
        often = (masked * x0.shape[1] >= 0.5).double()  # half a slot of a scene on average
        t = torch.multinomial(often, count, replacement=True, generator=generator)
        noise = torch.randn(x0.shape, generator=generator).to(self.device)
        x_t = prior.add_noise(x0, t.to(self.device), noise)  # as in sampling, no objects but fixed ones are observed
        text, scene = prior.unconditional(count) if text is None else text, Scene(state_of(x_t[..., POSE_FEATURES:]))
        network.take_text(scene, *((None, None) if text is None else text))
        inputs, observed = network.count_logits.inputs(scene), prior.observed_entries(x_t)
        _, logits = prior.denoiser.output(x_t, t.to(self.device), observed, text, [self.config.module])
        drawn = scene.states == prior.num_categories
        chance = drawn + torch.rand(drawn.shape, generator=generator).to(self.device)
        slots = chance.topk(min(_SLOTS, drawn.shape[1]), dim=1).indices
        category = torch.where(drawn, state_of(x0[..., POSE_FEATURES:]), -100).gather(1, slots)
        logits = logits.gather(1, slots[..., None].expand(-1, -1, logits.shape[2]))
        rate = (1 - masked[t - 1] / masked[t]) * often.sum() / x0.shape[1]  # at which masked slots are unmasked
        weight = rate * (drawn.sum(dim=1) / (category >= 0).sum(dim=1).clamp(min=1)).cpu()
        kept = {"inputs": inputs, "logits": logits.half(), "category": category.short(), "weight": weight.float()}
        return {key: value.cpu() for key, value in kept.items()}

    def _schedule(self) -> LambdaLR:
        """Schedule of the learning rate from the present step on; it depends only on the number of the step."""
        for group in self.optimizer.param_groups:
            group["initial_lr"] = group["rate"]
        return LambdaLR(self.optimizer, lambda step: learning_rate_at(step, self.config), last_epoch=self.step - 1)

    def _save(self) -> None:
        if self.processes.is_first:
            state = {
                "config": asdict(self.config),
                "network": self.network.state_dict(),
                "average": self.average.tensors,
                "average_updates": self.average.updates,
                "optimizer": self.optimizer.state_dict(),
                "step": self.step,
                "seconds": self.seconds,
                "history": self.history,
                "data": self._data_facts(),
                "states": self.states,
            }
            save_checkpoint(self.checkpoint_path, state)
        self.save_prior()

    def _load(self) -> None:
        state = load_checkpoint(self.checkpoint_path)
        check_same_keys(self.directory, state["config"], asdict(self.config), _MAY_DIFFER, type(self.config))
        facts, known = self._data_facts(), state.get("data")
        if known is not None and not (
            known["scenes"] == facts["scenes"] and torch.allclose(known["mean"], facts["mean"], rtol=1e-3, atol=1e-4)
        ):
            raise InvalidInputError(
                f"the run in {str(self.directory)!r} was started with other scenes than data={self.config.data!r} "
                "holds now; give the same dataset to resume it, or another output"
            )
        check_tensors(self.network, state["network"], self.checkpoint_path)
        try:
            self.history = state["history"]
            self.network.load_state_dict(state["network"])
            self.average.restore(state["average"], state["average_updates"])
            self.optimizer.load_state_dict(state["optimizer"])
        except (RuntimeError, ValueError, KeyError) as error:
            raise InvalidInputError(
                f"the run in {str(self.directory)!r} cannot be resumed: it has another network or optimiser; "
                "give the same keys again, or another output"
            ) from error
        self.step, self.seconds, self.states = state["step"], state["seconds"], state.get("states", {})
        self.schedule = self._schedule()
        logger.info("resumed at step %d", self.step)

    def _data_facts(self) -> dict[str, Any]:
        """Facts with which a resumed run checks its data: numbers of scenes, and means of the held-out ones."""
        heldout = self.heldout_data.double()
        mean = torch.stack([heldout.mean(dim=(0, 1)), heldout.square().mean(dim=(0, 1))])
        return {"scenes": [self.data.size or 0, len(heldout)], "mean": mean}

    def save_prior(self) -> ScenePrior:
        """Write the prior with averaged weights to ``output/prior``, and return it."""
        with averaged_weights(self.network, self.average):
            self.prior.card = {
                **self._origin,
                "trained_steps": self.step,
                "batch_size": self.config.batch_size,
                "training_scenes": self.data.size or self.step * self.config.batch_size,
                "seconds": round(self.seconds),
                "heldout_loss": self.evaluations[-1]["heldout"] if self.evaluations else None,
            }
            if self.processes.is_first:
                self.prior.save(self.directory / "prior")
        self.processes.wait()
        return ScenePrior.load(self.directory)


def _origin(base: str, card: Mapping[str, Any]) -> dict[str, Any]:
    """Entries of a card that stay true if the prior ``base`` is trained further; none for a fresh prior."""
    if not base:
        return {}
    kept = {key: card[key] for key in ("imported_from", "license", "post_training") if key in card}
    return {**kept, "base": {"name": short_name(base), "trained_steps": card.get("trained_steps")}}


def pretrain(config: PretrainConfig) -> dict[str, Any]:
    """Train a prior as ``config`` says; resumes a run found in ``config.output``.

    Returns:
        The numbers of ``metrics.json``, which is written to the run folder.
    """
    with claimed(config.directory, "pretrain") if is_first_process() else nullcontext():
        prior, data, heldout = prepare(config)
        trainer = Pretrainer(config, data, heldout, prior)
        trained = trainer.run()
        metrics = {**trained.card, "evaluations": trainer.evaluations}
        if not trainer.processes.is_first:
            return metrics
        write_text(trainer.directory / "config.yaml", sealed(config_text(config)))
        write_json(trainer.directory / "metrics.json", metrics)
        return metrics


def warm_up_text(prior: ScenePrior, data: TrainingData, steps: int, batch_size: int, seed: int) -> float | None:
    """Train the text encoder, and the layers that predict numbers from it, in place on prompts and counts of their
    scenes only, if the prior has count conditioning. No scene is denoised, so hundreds of steps take a minute; the run
    then starts with predicted numbers. The same seed gives the same weights. Returns the mean loss of the last tenth of
    the steps, nats per kind of object; None if nothing was trained.
    """
    conditioning = prior.count_conditioning
    if conditioning is None or steps < 1:
        return None
    parameters = [*prior.denoiser.text_encoder.parameters(), *conditioning.counts_out.parameters()]
    optimizer = torch.optim.AdamW(parameters, lr=_RATE, weight_decay=0.01)

    def rate(step: int) -> float:
        done = (step + 1) / steps
        return done / _RISE if done < _RISE else 0.5 * (1.0 + math.cos(math.pi * (done - _RISE) / (1.0 - _RISE)))

    schedule, losses = LambdaLR(optimizer, rate), []
    for step in range(steps):
        generator = derived_generator(seed, step, steps)
        scenes, prompts = data.draw(batch_size, generator, prompts=True)
        picks = torch.rand(len(prompts), generator=generator).tolist()
        texts = [group[int(pick * len(group))] for group, pick in zip(prompts, picks, strict=True)]
        asked = prior.encode_prompts(texts)[0][:, : conditioning.things]
        states = scenes[..., POSE_FEATURES:].argmax(dim=-1).to(asked.device)
        loss = conditioning.count_loss(asked, states).mean()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        optimizer.zero_grad(set_to_none=True)
        losses.append(float(loss.detach()))
    last = losses[-max(1, steps // 10) :]
    logger.info("numbers are read from prompts at %.3f nats per kind of object after %d steps", np.mean(last), steps)
    return float(np.mean(last))
