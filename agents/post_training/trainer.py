"""Post-training loop: sampling, scores, updates of the prior, and checks of the guard."""

from __future__ import annotations

import csv
import io
import math
import time
from contextlib import closing, nullcontext
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict
from torch import Generator

from agents.configuration.composition import check_same_keys, config_text
from agents.configuration.prior_names import short_name
from agents.post_training.algorithms.base import no_credit_per_object
from agents.post_training.guard import Guard, GuardReading, SampleCheck, realism
from agents.post_training.learner import Learner, NonFiniteGradient
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.real_scenes import SceneBank, kept_base_samples, kept_scenes
from agents.post_training.rollouts import PromptSets, gathered_scenes, reward_figures, run_prompts, stream_seed
from agents.post_training.run_files import CHECKPOINT_NAME, METRICS_NAME, draw_curve, run_progress
from agents.post_training.settings import RESUMABLE, PostTrainConfig
from agents.priors.prior import ScenePrior, check_object_count, no_text
from agents.utils.checkpoints import check_tensors, load_checkpoint, save_checkpoint
from agents.utils.interrupts import finishing_steps
from agents.utils.loggers import RunLogger
from agents.utils.process_group import ProcessGroup, launched_processes
from agents.utils.weight_average import averaged_weights
from rewards import reward_label
from scene_envs.arrays import resolve_device
from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import InvalidInputError, TrainingError
from scene_envs.files import claimed, sealed, write_json, write_text
from scene_envs.scene import SceneBatch

MAX_INVALID = 3
"""Consecutive batches without a valid reward after which a run stops."""
_MAX_ROLLBACKS = 3
"""Number of returns to the best checkpoint that a run may make; one more ends it."""
_PROBED = 2
"""Real scenes on which the reward of a run is tried."""
_PROBED_WITH_PROMPTS = 8
"""The same number in a run that uses the prompts of its real scenes."""
_PICTURED = 6
"""Number of the guard's samples that are kept for the report."""
_STATE = ("iteration", "invalid_streak", "rollbacks", "seconds", "history")
"""Attributes of a trainer that are kept in a checkpoint."""


@dataclass(frozen=True)
class PostTrainResult:
    """Result of a finished run.

    Attributes:
        prior: best prior within the guard's limit, on the device of the run; also in ``directory / "prior"``.
        history: one row of the log per iteration.
        metrics: contents of ``metrics.json``.
        directory: folder of the run.
        config: configuration of the run, also in ``config.yaml``.
    """

    prior: ScenePrior
    history: list[dict[str, float]]
    metrics: dict[str, Any]
    directory: Path
    config: PostTrainConfig


def post_train(config: PostTrainConfig, *, prior: ScenePrior | None = None, after: float = 0.0) -> PostTrainResult:
    """Post-train a prior with regularisation on real scenes; resumes a run found in ``config.output``.

    Processes that ``torchrun`` started share each batch and take the same steps as a single process. Only the first
    process writes files.

    Args:
        config: configuration of the run.
        prior: prior to start from, instead of the one that ``config.prior`` names; it is not changed.
        after: work of the caller that follows, in iterations; the time left that is shown includes it.

    Raises:
        TrainingError, StorageError: a gradient or a value of the prior is not finite, no reward was valid for too long,
            the disk is full, or another process ended. The run can be resumed.
        CorruptFileError: the checkpoint in the run directory is truncated.
        InvalidInputError: a setting is wrong, the directory holds a run of another configuration, or the processes
            do not divide the batch.

    >>> from tempfile import TemporaryDirectory
    >>> from agents.priors.testing import tiny_prior
    >>> with TemporaryDirectory() as output:
    ...     config = PostTrainConfig(output=output, iterations=2, batch_size=4, num_steps=4,
    ...         algorithm={"gradient_steps": 2}, regularisation={"bank_size": 20, "batch_size": 4},
    ...         guard={"scenes": 8}, progress="none")
    ...     result = post_train(config, prior=tiny_prior())
    >>> len(result.history), result.history[0]["log_ratio"]
    (2, 0.0)
    """
    if config.batch_size % (count := launched_processes()):
        lower = config.batch_size // count * count
        nearest = f"{lower} or {lower + count}" if lower else str(count)
        raise InvalidInputError(
            f"batch_size={config.batch_size} is not a multiple of {count}, the number of processes; give "
            f"batch_size={nearest}, or another number of processes"
        )
    processes = ProcessGroup.join(str(resolve_device(config.device, None if prior is None else prior.device)))
    claim = claimed(config.directory, "post_train") if processes.is_first else nullcontext()
    with claim, closing(PostTrainer(config, prior=prior)) as trainer:
        return trainer.run(after)


class PostTrainer:
    """One run: its loop, its guard and its files; ``prior`` is that to start from, None the one of ``config.prior``."""

    guard: Guard
    scenes: SceneBank

    def __init__(self, config: PostTrainConfig, *, prior: ScenePrior | None = None) -> None:
        self.config, self.plain = config, config.plain()
        self.directory = config.directory
        self.processes = ProcessGroup.current()
        base = cast(ScenePrior, resolve_prior(config.prior if prior is None else prior, config.device))
        self.device = base.device
        if config.prompt is not None and not base.conditional:
            raise no_text(base.scene_type, str(config.prompt))
        self._base: ScenePrior | None = base  # until the guard has measured it
        self.base_name = short_name(base.loaded_as) if base.loaded_as else ""
        self.prior = deepcopy(base).eval()
        policy = DenoisingPolicy(self.prior, config.num_steps, chunk=config.optimizer.chunk, guidance=config.guidance)
        self.learner = Learner(
            policy, config.running(config.reward), config.algorithm, config.optimizer, config.regularisation,
            batch_size=config.batch_size, slots=config.slots, prompt=config.prompt, workers=config.workers,
            physics=config.physics, seed=config.seed,
        )  # fmt: skip
        self.iteration = self.invalid_streak = self.rollbacks = 0
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []
        self.logger = RunLogger(config.logger.name if self.processes.is_first else "csv", self.directory)

    def close(self) -> None:
        """Stop physics workers, if any, and close the logger."""
        self.learner.close()
        self.logger.close()

    # -- the loop -------------------------------------------------------------------------------

    def run(self, after: float = 0.0) -> PostTrainResult:
        """Train until ``config.iterations``, or until the guard stops the run; the result holds the best prior. Work
        ``after`` the run, in iterations, counts in the time left that is shown.
        """
        config = self.config
        path = self.directory / CHECKPOINT_NAME
        state = load_checkpoint(path) if path.exists() else None
        if state is not None:
            check_same_keys(self.directory, state.get("config", {}), self.plain, RESUMABLE, PostTrainConfig)
        self.prepare(reuse_scenes=state is not None)
        if state is not None:
            self._restore(state)
        else:
            if self.processes.is_first:
                write_text(self.directory / "config.yaml", sealed(config_text(self.plain)))
            if self.learner.learned:  # a reward that learns is another one later
                self._start_guard()
            self._keep(self.prior)  # the best prior so far is the base
        title = f"post-train {self.prior.scene_type.name}"
        started = time.perf_counter() - self.seconds
        self._write_log()  # removes the rows of an earlier run, or rows beyond the checkpoint
        style = config.progress if self.processes.is_first else "none"
        with run_progress(title, config.iterations, style, self.iteration, after) as report, finishing_steps() as end:
            while self.iteration < config.iterations and not self._stopped:
                batch, row = self.step()
                self.seconds = time.perf_counter() - started
                self.history.append({**row, "seconds": round(self.seconds, 2)})
                last = self.iteration == config.iterations
                sample = last or self.iteration % config.guard.samples_every == 0
                checked = self.iteration % config.guard.every == 0 or last or (sample and config.guard.sampled > 0)
                if checked:
                    self._check(batch, sample=sample)
                # a rollback reads prior/, which must be of the same iteration as the checkpoint
                due = self.iteration % config.logger.checkpoint_every == 0 or (
                    checked and config.guard.action == "rollback"
                )
                ending = self.processes.any(end.pending)
                if due or last or self._stopped or ending:
                    self.save()
                self._write_log()
                self.logger.log(self.history[-1], self.iteration)
                report(self.iteration, row["reward"], self.guard.ratio)
                end(ending)
        return self._finish()

    def prepare(self, *, reuse_scenes: bool = False) -> None:
        """Draw the real scenes, or reuse those in the folder of a resumed run, and make the guard."""
        config, seed, slots = self.config, stream_seed(self.config.seed, "bank"), self.learner.slots
        shown = config.progress if self.processes.is_first else "none"
        batch = kept_scenes(
            self.directory, self.prior, config.regularisation, seed, slots, reuse=reuse_scenes, progress=shown
        )
        prompts: PromptSets | None = None
        if self.prior.conditional:
            prompts = run_prompts(self.directory, batch, seed)
            if config.prompt == "data":
                large = torch.nonzero(batch.counts > slots)[:, 0].tolist()
                check_object_count([text for i in large for text in prompts(i)], self.prior.scene_type, slots)
        x0 = self.prior.encode(batch.to(self.device))
        self.scenes = SceneBank.split(x0, config.guard.scenes, prompts)
        self.learner.deal_prompts(self.scenes)
        self.learner.begin_rewards(batch[: len(self.scenes.train)], first=not reuse_scenes)
        if not reuse_scenes:
            self._try_reward(batch, prompts)
        base = self.learner.regularisation.base
        if base is not None:
            samples = kept_base_samples(
                self.directory, base, self.scenes, config.regularisation.base_samples, config.seed,
                num_steps=config.num_steps, batch_size=config.batch_size, reuse=reuse_scenes, progress=shown,
            )  # fmt: skip
            self.scenes = replace(self.scenes, base=samples)
        self.guard = self._make_guard()

    def _try_reward(self, real: SceneBatch, prompts: PromptSets | None) -> None:
        """Score real scenes as the scenes of the run will be. If the run uses prompts of real scenes, more scenes are
        tried, each with all of its prompts, because a reward may read only one kind. With other prompts it may be that
        no real scene can be scored; such a run is not refused.
        """
        config, learner, scene_type = self.config, self.learner, self.prior.scene_type
        if config.guard.limits.stack is not None and not scene_type.has_geometry:
            raise InvalidInputError(
                f"guard.limits.stack={config.guard.limits.stack} needs the geometry of the assets, and those of "
                f"{scene_type.name!r} have none here; leave it out"
            )
        scenes, texts = real[:_PROBED], None
        if config.prompt == "data" and prompts is not None:
            pairs = [(row, text) for row in range(min(_PROBED_WITH_PROMPTS, len(real))) for text in prompts(row)]
            scenes, texts = real[torch.tensor([row for row, _ in pairs])], [text for _, text in pairs]
        elif learner.deck is not None:
            texts = learner.deck.deal(len(scenes), Generator().manual_seed(config.seed))
        score = learner.scorer(scenes, texts)
        valid = bool(score.valid.any())
        if valid and score.per_object is None and getattr(config.algorithm, "credit", "") == "object":
            raise no_credit_per_object()
        if config.prompt in (None, "data") and not self.processes.any(valid):
            paired = "" if texts is None else " with a prompt"
            raise self._nothing_scored(f"none of {len(scenes)} real scenes{paired}, so that nothing was sampled")

    def _make_guard(self) -> Guard:
        config, scenes, slots = self.config, self.scenes, self.learner.slots
        count, check = config.guard.sampled, None
        if count:
            check = SampleCheck(
                self.prior.decode(scenes.heldout[:count]).to("cpu"),
                self.learner.scorer,
                count,
                config.num_steps,
                stream_seed(config.seed, "samples"),
                slots,
                None if config.prompt is None else scenes.heldout_prompts(count, slots, self.prior.scene_type),
                config.guidance,
            )
        target = config.regularisation.hold
        return Guard(
            scenes.heldout,
            config.guard.limit,
            stream_seed(config.seed, "guard"),
            scenes.heldout_prompts,
            check,
            config.guard.sample_limits(config.algorithm.sample_limits),
            math.inf if target is None else target,
            bool(self.learner.learned),
        )

    def step(self) -> tuple[TensorDict, dict[str, float]]:
        """One iteration: a batch of fresh scenes and its updates. Returns the batch and the row for the log."""
        batch = self.learner.in_memory(lambda: self.learner.rollout(self.iteration))
        row = {"iteration": float(self.iteration + 1), **reward_figures(batch)}
        if row["valid_fraction"] > 0:
            self.invalid_streak = 0
            row |= self._learn(batch)
        elif self.iteration == 0:
            raise self._nothing_scored("no scene of the first batch")
        else:
            self.invalid_streak += 1
            if self.invalid_streak >= MAX_INVALID:
                raise self._nothing_scored(
                    f"no scene in {self.invalid_streak} batches in a row, the last at iteration {self.iteration + 1}"
                )
        self.learner.learn_rewards(batch)
        self.iteration += 1
        return batch, row

    def _learn(self, batch: TensorDict) -> dict[str, float]:
        row: dict[str, float] = {}
        batch = self.learner.write_advantage(batch)
        updates = self.config.algorithm.optimiser_steps
        for update in range(updates):
            index = self.iteration * updates + update
            try:
                row = self.learner.in_memory(partial(self.learner.update, batch, self.scenes, index))
            except NonFiniteGradient as error:
                raise self._not_finite(error.figures) from None
        self.learner.algorithm.end_iteration()
        return row

    # -- guard ----------------------------------------------------------------------------------

    @property
    def _stopped(self) -> bool:
        if self.config.guard.action == "rollback":
            return self.rollbacks > _MAX_ROLLBACKS
        return self.config.guard.action == "stop" and self.guard.over_limit_at is not None

    def _start_guard(self) -> None:
        """Measure the base prior, with which later checks are compared; done before the first of them."""
        if self._base is not None and math.isnan(self.guard.base_loss):
            self.guard.start(deepcopy(self._base).eval())
        self._base = None

    def _check(self, batch: TensorDict, *, sample: bool) -> None:
        self._start_guard()
        since = self.guard.readings[-1].iteration if self.guard.readings else 0
        recent = [row["reward"] for row in self.history[since:] if math.isfinite(row["reward"])]
        reward = sum(recent) / len(recent) if recent else float("nan")
        scenes = gathered_scenes(batch)
        with averaged_weights(self.prior, self.learner.algorithm.average) as prior:
            reading = self.guard.check(prior, self.iteration, reward, realism(scenes), sample=sample)
            if reading.kept:
                self._keep(prior)
        self.learner.regularisation.observe(reading.ratio, self.iteration)
        figures = {f"guard_{name}": value for name, value in reading.samples.items()}
        self.history[-1] |= {"guard_loss": reading.loss, "guard_ratio": reading.ratio, **figures, **reading.realism}
        self._picture(reading)
        if reading.beyond and self.config.guard.action == "rollback":
            self.rollbacks += 1
            self.learner.return_to(self._best())
            self.learner.regularisation.return_to_checkpoint(self.guard.best_ratio)

    def _nothing_scored(self, what: str) -> TrainingError:
        return TrainingError(
            f"the reward {self.plain['reward']!r} scored {what}; the warnings above say why, and "
            "`scene-envs check-reward` tries a reward on its own"
        )

    def _not_finite(self, figures: dict[str, float]) -> TrainingError:
        numbers = ", ".join(f"{name} {figures[name]:.3g}" for name in ("policy_loss", "pretraining_loss"))
        return TrainingError(
            f"iteration {self.iteration + 1} gave a gradient that is not finite ({numbers}); it was not applied. "
            f"The last good checkpoint is {str(self.directory / CHECKPOINT_NAME)!r}, the best prior so far "
            f"{str(self.directory / 'prior')!r}. Lower optimizer.lr (now {self.config.optimizer.lr:g})"
        )

    # -- files ----------------------------------------------------------------------------------

    def _keep(self, prior: ScenePrior) -> None:
        """Write the evaluated weights to ``prior/``, with a card that says how they were made."""
        # figures of the base prior are not those of other weights
        unknown = ("measures", "limits") if self.iteration else ()
        prior.card = {
            **{key: value for key, value in prior.card.items() if key not in unknown},
            "post_training": {
                "algorithm": self.config.algorithm.name,
                **({"base": self.base_name} if self.base_name else {}),
                "reward": self.plain["reward"],
                "iteration": self.iteration,
                "mean_reward": self.guard.best_reward if self.iteration else None,
                "guard_ratio": self.guard.ratio,
            },
        }
        if self.processes.is_first:
            prior.save(self.directory / "prior")

    def _best(self) -> ScenePrior:
        """The prior that was kept last."""
        self.processes.wait()  # until it is written
        return ScenePrior.load(self.directory / "prior")

    def _picture(self, reading: GuardReading) -> None:
        """Keep the samples of the best checkpoint, and of the first check beyond a limit, for the report."""
        batch = self.guard.last_samples
        first = reading.beyond and self.guard.over_limit_at == reading.iteration
        if batch is None or not reading.samples or not (reading.kept or first) or not self.processes.is_first:
            return
        batch[:_PICTURED].save(self.directory / f"{'guard_within' if reading.kept else 'guard_beyond'}.safetensors")

    def save(self) -> None:
        """Write the resumable checkpoint, which is the same in all processes."""
        if not self.processes.is_first:
            return
        state = {
            "config": self.plain,
            **{name: getattr(self, name) for name in _STATE},
            "guard": self.guard.state(),
            "learner": self.learner.state(),
        }
        save_checkpoint(self.directory / CHECKPOINT_NAME, state)

    def _write_log(self) -> None:
        """One row per iteration, with the union of the columns of all rows."""
        text = io.StringIO()
        columns = list(dict.fromkeys(name for row in self.history for name in row))
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.history)
        if self.processes.is_first:
            write_text(self.directory / "log.csv", text.getvalue())

    def _restore(self, state: dict[str, Any]) -> None:
        for name in _STATE:
            setattr(self, name, state[name])
        self.guard.restore(state["guard"])
        check_tensors(self.prior, state["learner"]["prior"], self.directory / CHECKPOINT_NAME)
        self.learner.restore(state["learner"])

    def _finish(self) -> PostTrainResult:
        rewards = [row["reward"] for row in self.history if math.isfinite(row["reward"])]
        invalid = sum((1.0 - row["valid_fraction"]) * self.config.batch_size for row in self.history)
        metrics = {
            "iterations": len(self.history),
            "seconds": round(self.seconds, 1),
            "reward": {
                "first": rewards[0] if rewards else None,
                "last": rewards[-1] if rewards else None,
                "best": self.guard.best_reward,
                "invalid_scenes": round(invalid),
            },
            "guard": {**self.guard.summary(), "rollbacks": self.rollbacks},
            "hold": self.learner.regularisation.summary(),
        }
        if self.processes.is_first:
            write_json(self.directory / METRICS_NAME, metrics)
            draw_curve(
                self.history,
                self.directory / "curve.png",
                reward_name=f"mean {reward_label(self.config.reward)}",
                limit=self.config.guard.limit,
                beyond=self.guard.over_limit_at,
                highest=self.learner.largest_reward(),
            )
        return PostTrainResult(self._best().to(self.device), self.history, metrics, self.directory, self.config)
