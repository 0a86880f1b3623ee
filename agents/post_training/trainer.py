"""Post-training loop: sample scenes, score them, update the prior, check the guard."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from agents.post_training.config import PostTrainConfig
from agents.post_training.curves import draw_curve
from agents.post_training.guard import Guard, GuardReading, realism
from agents.post_training.learner import Learner, NonFiniteGradient
from agents.post_training.progress import run_progress
from agents.post_training.prompts import PROMPTS_NAME, PromptSets, prompts_beside, save_prompts
from agents.post_training.rollouts import Rollout, stream_seed
from agents.post_training.run_files import (
    CHECKPOINT_NAME,
    SCENES_NAME,
    load_resumable,
    write_config,
    write_log,
    write_metrics,
)
from agents.post_training.sample_check import SampleCheck
from agents.post_training.scene_bank import SceneBank, real_scenes
from agents.priors.adapters import save_adapter, with_adapter_of
from agents.priors.base import ScenePrior
from agents.priors.prompt_validation import check_object_count
from agents.utils.checkpoints import save_checkpoint
from agents.utils.interrupts import finishing_steps
from agents.utils.loggers import make_logger
from rewards import reward_name
from scene_envs.errors import TrainingError
from scene_envs.folders import claimed
from scene_envs.scene import SceneBatch

_MOST_ROLLBACKS = 3
"""Returns to the best checkpoint after which a run ends."""
_PICTURED = 6
"""Samples of the guard that are kept for the report."""


@dataclass(frozen=True)
class PostTrainResult:
    """A finished run.

    Attributes:
        prior: the best prior within the guard's limit; on disk in ``directory / "prior"``.
        history: one row per iteration.
        metrics: what ``metrics.json`` holds.
        directory: the run directory.
        config: what was run; on disk in ``config.yaml``.
    """

    prior: ScenePrior
    history: list[dict[str, float]]
    metrics: dict[str, Any]
    directory: Path
    config: PostTrainConfig


def post_train(config: PostTrainConfig, *, prior: ScenePrior | None = None) -> PostTrainResult:
    """Post-train a prior with DDPO-SF and regularisation on real scenes; resumes a run found in ``config.output``.

    Args:
        config: the run.
        prior: the prior itself, in place of the one that ``config.prior`` names; it is left as it was.

    Raises:
        TrainingError: NaN, no valid reward for too long, or a full disk. The run can be resumed.
        CorruptFileError: the checkpoint in the run directory is truncated.
        InvalidInputError: a setting is wrong, or the directory holds a run of another configuration.

    >>> from tempfile import TemporaryDirectory
    >>> from agents.priors.testing import tiny_prior
    >>> with TemporaryDirectory() as output:
    ...     config = PostTrainConfig(output=output, iterations=2, batch_size=4, num_steps=4,
    ...         algorithm={"gradient_steps": 2}, regularisation={"bank_size": 20, "batch_size": 4},
    ...         guard={"scenes": 8}, logger={"progress": "none"})
    ...     result = post_train(config, prior=tiny_prior())
    >>> len(result.history), result.history[0]["log_ratio"]
    (2, 0.0)
    """
    with claimed(config.directory, "post_train"):
        trainer = PostTrainer(config, prior=prior)
        try:
            return trainer.run()
        finally:
            trainer.close()


class PostTrainer:
    """One run: its loop, its guard and its files.

    Args:
        config: the run.
        prior: in place of the one that ``config.prior`` names.
    """

    guard: Guard
    scenes: SceneBank

    def __init__(self, config: PostTrainConfig, *, prior: ScenePrior | None = None) -> None:
        self.config = config
        self.directory = config.directory
        self.learner = Learner(config, ScenePrior.load(config.prior if prior is None else prior))
        self.prior = self.learner.prior
        self.iteration = 0
        self.invalid_streak = 0
        self.rollbacks = 0
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []
        self.logger = make_logger(config.logger.name, self.directory)

    def close(self) -> None:
        """Stop physics workers, if any, and close the logger."""
        self.learner.close()
        self.logger.close()

    # -- the loop -------------------------------------------------------------------------------

    def run(self) -> PostTrainResult:
        """Go on to ``config.iterations``, or to the guard's stop, and return the best prior."""
        config = self.config
        state = load_resumable(self.directory, config)
        self.prepare(reuse_scenes=state is not None)
        if state is not None:
            self._restore(state)
        else:
            write_config(self.directory, config)
            self.guard.start(self.prior)
            self._save_prior()  # until something better: the base
        title = f"post-train {self.prior.scene_type.name}"
        started = time.perf_counter() - self.seconds
        write_log(self.directory, self.history)  # that of an earlier run, or rows beyond the checkpoint, go
        with (
            run_progress(title, config.iterations, config.logger.progress, self.iteration) as report,
            finishing_steps() as end,
        ):
            while self.iteration < config.iterations and not self._stopped:
                rollout, row = self.step()
                self.seconds = time.perf_counter() - started
                self.history.append({**row, "seconds": round(self.seconds, 2)})
                last = self.iteration == config.iterations
                sample = last or self.iteration % config.guard.samples_every == 0
                checked = self.iteration % config.guard.every == 0 or last or (sample and config.guard.sampled > 0)
                if checked:
                    self._check(rollout, sample=sample)
                due = self.iteration % config.logger.checkpoint_every == 0 or (
                    checked and config.guard.action == "rollback"  # which reads prior/: both are of one iteration
                )
                if due or last or self._stopped or end.pending:
                    self.save()
                write_log(self.directory, self.history)
                self.logger.log(self.history[-1], self.iteration)
                report(self.iteration, row["reward"], self.guard.ratio)
                end()
        return self._finish()

    def prepare(self, *, reuse_scenes: bool = False) -> None:
        """Draw the real scenes, or reuse those kept beside a run that is resumed, and make the guard."""
        config, path, texts = self.config, self.directory / SCENES_NAME, self.directory / PROMPTS_NAME
        seed = stream_seed(config.seed, "bank")
        if reuse_scenes and path.exists():
            batch = SceneBatch.load(path)
        else:
            slots = self.learner.slots
            batch, found = real_scenes(
                self.prior, config.regularisation.scenes, config.regularisation.bank_size, seed=seed, slots=slots
            )
            _writing(f"the real scenes {str(path)!r}", lambda: batch.save(path))
            texts.unlink(missing_ok=True)  # of other scenes, by a run that never reached a checkpoint
            if found is not None and self.prior.conditional:
                _writing(f"their prompts {str(texts)!r}", lambda: save_prompts(texts, found))
        prompts: PromptSets | None = None
        if self.prior.conditional:
            prompts = prompts_beside(self.directory, batch, seed)
            if config.prompt == "data":
                large = torch.nonzero(batch.counts > self.learner.slots)[:, 0].tolist()
                check_object_count(
                    [text for i in large for text in prompts(i)], self.prior.scene_type, self.learner.slots
                )
        x0 = self.prior.encode(batch.to(config.device))
        self.scenes = SceneBank.split(x0, config.guard.scenes, prompts)
        asked = self.scenes.heldout_prompts()
        seed = stream_seed(config.seed, "guard")
        limits = config.guard.limits(config.algorithm.sample_limits)
        self.guard = Guard(self.scenes.heldout, config.guard.limit, seed, asked, self._sample_check(asked), limits)
        self.learner.deal_prompts(self.scenes)

    def step(self) -> tuple[Rollout, dict[str, float]]:
        """One iteration: a batch of fresh scenes and its updates. Returns the scenes and the row for the log."""
        rollout = self.learner.rollout(self.iteration)
        row = {"iteration": float(self.iteration + 1), **_reward_figures(rollout)}
        if bool(rollout.valid.any()):
            self.invalid_streak = 0
            row |= self._learn(rollout)
        else:
            self._count_invalid()
        self.iteration += 1
        return rollout, row

    def _learn(self, rollout: Rollout) -> dict[str, float]:
        row: dict[str, float] = {}
        advantage = self.learner.algorithm.advantage(rollout)
        updates = self.config.algorithm.optimiser_steps
        for update in range(updates):
            index = self.iteration * updates + update
            try:
                row = self.learner.update(rollout, advantage, self.scenes, index)
            except NonFiniteGradient as error:
                raise self._not_finite(error.figures) from None
        self.learner.algorithm.end_iteration()
        self.learner.regularisation.observe("kl", row.get("kl"), self.iteration + 1)
        return row

    # -- guard ----------------------------------------------------------------------------------

    @property
    def _stopped(self) -> bool:
        if self.config.guard.action == "rollback":
            return self.rollbacks > _MOST_ROLLBACKS
        return self.config.guard.action == "stop" and self.guard.over_limit_at is not None

    def _sample_check(self, prompts: Sequence[str] | None) -> SampleCheck | None:
        """What the guard samples; None where it does not."""
        config = self.config
        count = config.guard.sampled
        if not count:
            return None
        return SampleCheck(
            self.prior.decode(self.scenes.heldout[:count]).to("cpu"),
            self.learner.env.core.scorer,
            count,
            config.num_steps,
            stream_seed(config.seed, "samples"),
            self.learner.slots,
            prompts[:count] if prompts is not None and config.prompt is not None else None,
            config.guidance,
        )

    def _check(self, rollout: Rollout, *, sample: bool) -> None:
        since = self.guard.readings[-1].iteration if self.guard.readings else 0
        recent = [row["reward"] for row in self.history[since:] if math.isfinite(row["reward"])]
        reward = sum(recent) / len(recent) if recent else float("nan")
        with self.learner.averaged() as prior:
            reading = self.guard.check(prior, self.iteration, reward, realism(rollout.batch), sample=sample)
            if reading.kept:
                self._save_prior()
        self.learner.regularisation.observe("guard", reading.ratio, self.iteration)
        figures = {f"guard_{name}": value for name, value in reading.samples.items()}
        self.history[-1] |= {"guard_loss": reading.loss, "guard_ratio": reading.ratio, **figures, **reading.realism}
        self._picture(reading)
        if reading.beyond and self.config.guard.action == "rollback":
            self.rollbacks += 1
            self.learner.return_to(
                ScenePrior.load(self.directory / "prior")
                if self.prior.adapter is None
                else with_adapter_of(self.prior, self.directory)
            )

    def _picture(self, reading: GuardReading) -> None:
        """Keep the guard's samples of the best checkpoint, and of the first beyond a limit, for the report."""
        batch = self.guard.last_samples
        name = "guard_within" if reading.kept else "guard_beyond"
        first = reading.beyond and self.guard.over_limit_at == reading.iteration
        if batch is None or not reading.samples or not (reading.kept or first):
            return
        path = self.directory / f"{name}.safetensors"
        _writing(f"the guard's samples {str(path)!r}", lambda: batch[:_PICTURED].save(path))

    def _count_invalid(self) -> None:
        self.invalid_streak += 1
        if self.invalid_streak < self.config.guard.max_invalid:
            return
        raise TrainingError(
            f"the reward {self.config.plain()['reward']!r} scored no scene in {self.invalid_streak} batches in a row, "
            f"the last at iteration {self.iteration + 1}; the warnings above say why, and `scene-envs check-reward` "
            "tries a reward on its own"
        )

    def _not_finite(self, figures: dict[str, float]) -> TrainingError:
        numbers = ", ".join(f"{name} {figures[name]:.3g}" for name in ("policy_loss", "pretraining_loss"))
        return TrainingError(
            f"iteration {self.iteration + 1} gave a gradient that is not finite ({numbers}); it was not applied. "
            f"The last good checkpoint is {str(self.directory / CHECKPOINT_NAME)!r}, the best prior so far "
            f"{str(self.directory / 'prior')!r}. Lower optimizer.lr (now {self.config.optimizer.lr:g})"
        )

    # -- files ----------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the resumable checkpoint."""
        state = {
            "config": self.config.plain(),
            "iteration": self.iteration,
            "invalid_streak": self.invalid_streak,
            "rollbacks": self.rollbacks,
            "seconds": self.seconds,
            "history": self.history,
            "guard": self.guard.state(),
            "learner": self.learner.state(),
        }
        save_checkpoint(self.directory / CHECKPOINT_NAME, state)

    def _restore(self, state: dict[str, Any]) -> None:
        self.iteration, self.invalid_streak = state["iteration"], state["invalid_streak"]
        self.rollbacks = state["rollbacks"]
        self.seconds, self.history = state["seconds"], list(state["history"])
        self.guard.restore(state["guard"])
        self.learner.restore(state["learner"])

    def _save_prior(self) -> None:
        """The evaluated weights, with a card that says how they were made."""
        self.prior.card = {
            **self.prior.card,
            "post_training": {
                "reward": self.config.plain()["reward"],
                "iteration": self.iteration,
                "mean_reward": self.guard.best_reward if self.iteration else None,
                "guard_ratio": self.guard.ratio,
            },
        }
        path = self.directory / "prior"
        _writing(f"the prior {str(path)!r}", lambda: self.prior.save(path))
        if self.prior.adapter is not None:
            _writing("the adapter", lambda: save_adapter(self.prior, self.directory))

    def _finish(self) -> PostTrainResult:
        rewards = [row["reward"] for row in self.history if math.isfinite(row["reward"])]
        metrics = {
            "iterations": self.iteration,
            "seconds": round(self.seconds, 1),
            "reward": {
                "first": rewards[0] if rewards else None,
                "last": rewards[-1] if rewards else None,
                "best": self.guard.best_reward,
                "invalid_scenes": round(
                    sum((1.0 - row["valid_fraction"]) * self.config.batch_size for row in self.history)
                ),
            },
            "guard": {**self.guard.summary(), "rollbacks": self.rollbacks},
            "hold": self.learner.regularisation.summary(),
        }
        write_metrics(self.directory, metrics)
        name = f"mean {reward_name(self.config.reward).replace('_', ' ')}"
        draw_curve(
            self.history,
            self.directory / "curve.png",
            reward_name=name,
            limit=self.config.guard.limit,
            beyond=self.guard.over_limit_at,
        )
        return PostTrainResult(
            ScenePrior.load(self.directory / "prior"), self.history, metrics, self.directory, self.config
        )


def _writing(what: str, write: Any) -> None:
    """Run ``write``; a disk that refuses becomes a TrainingError."""
    try:
        write()
    except (OSError, RuntimeError) as error:
        raise TrainingError(f"could not write {what} ({error}); free some space and run the same again") from error


def _reward_figures(rollout: Rollout) -> dict[str, float]:
    valid = rollout.valid
    reward = rollout.reward[valid]
    some = len(reward) > 0
    figures = {
        "reward": float(reward.mean()) if some else float("nan"),
        "reward_std": float(reward.std(unbiased=False)) if some else float("nan"),
        "valid_fraction": float(valid.float().mean()),
        "objects": float(rollout.batch.counts.float().mean()),
    }
    return figures | {f"term_{name}": float(term[valid].mean()) for name, term in rollout.terms.items() if some}
