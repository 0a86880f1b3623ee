"""The post-training loop: sample scenes, score them, follow the score function, stay a prior."""

from __future__ import annotations

import time
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Generator, Tensor, nn

from agents.checkpoints import save_checkpoint
from agents.post_training.advantages import compute_advantages
from agents.post_training.config import PostTrainConfig
from agents.post_training.gradients import (
    accumulate_policy_gradient,
    add_regularisation_gradient,
    credited_reward,
    draw_steps,
)
from agents.post_training.guard import Guard, realism
from agents.post_training.losses import DDPOSFLoss
from agents.post_training.policy import DenoisingPolicy, gradient_weights
from agents.post_training.progress import Progress
from agents.post_training.real_scenes import RealScenes, real_scenes
from agents.post_training.rollouts import Rollout, collect, stream_seed
from agents.post_training.run_files import (
    CHECKPOINT_NAME,
    SCENES_NAME,
    load_resumable,
    write_config,
    write_log,
    write_metrics,
)
from agents.pretraining import WeightAverage
from agents.prior import ScenePrior
from scene_envs.denoising_torchrl import DenoisingTorchRLEnv
from scene_envs.errors import TrainingError
from scene_envs.scene import SceneBatch


@dataclass(frozen=True)
class PostTrainResult:
    """A finished run.

    Attributes:
        prior: the best prior within the guard's limit; on disk in ``directory / "prior"``.
        history: one row per iteration.
        metrics: what ``metrics.json`` holds.
        directory: the run directory.
    """

    prior: ScenePrior
    history: list[dict[str, float]]
    metrics: dict[str, Any]
    directory: Path


def post_train(config: PostTrainConfig, *, prior: ScenePrior | None = None) -> PostTrainResult:
    """Post-train a prior with DDPO-SF and regularisation on real scenes; resumes a run found in ``config.output``.

    Args:
        config: the run.
        prior: the prior itself, in place of the one that ``config.prior`` names; it is left as it was.

    Raises:
        TrainingError: NaN, no valid reward for too long, or a full disk. The run can be resumed.
        CorruptFileError: the checkpoint in the run directory is truncated.
        InvalidInputError: a setting is wrong, or the directory holds a run of another configuration.
    """
    trainer = PostTrainer(config, prior=prior)
    try:
        return trainer.run()
    finally:
        trainer.close()


class PostTrainer:
    """The state of one run. All randomness derives from (seed, purpose, iteration), so resuming is exact.

    Args:
        config: the run.
        prior: in place of the one that ``config.prior`` names.
    """

    def __init__(self, config: PostTrainConfig, *, prior: ScenePrior | None = None) -> None:
        self.config = config
        self.directory = Path(config.output)
        self.prior = deepcopy(ScenePrior.load(config.prior if prior is None else prior)).to(config.device).eval()
        self.slots = self.prior.config.slots if config.slots is None else config.slots
        self.policy = DenoisingPolicy(self.prior, config.num_steps, chunk=config.chunk)
        self.stds = self.policy.stds(self.slots).cpu()
        weights = gradient_weights(
            self.stds, min_std=config.min_std, skip_first=config.skip_first, weighting=config.step_weighting
        )
        self.loss = DDPOSFLoss(
            self.policy,
            step_weights=weights.to(config.device),
            reduction=config.log_prob_reduction,
            clip_epsilon=config.clip_epsilon,
        )
        self.env = DenoisingTorchRLEnv(
            config.batch_size,
            scene=self.prior.scene_type,
            reward=config.reward,
            num_steps=config.num_steps,
            prior=self.prior,
            slots=self.slots,
            workers=config.workers,
        )
        parameters = [p for p in self.prior.parameters() if p.requires_grad]
        self.optimizer = torch.optim.AdamW(
            parameters, lr=config.learning_rate, weight_decay=config.weight_decay, betas=(0.9, 0.999)
        )
        self.average = WeightAverage(self.prior, config.ema) if config.ema else None
        self.iteration = 0
        self.invalid_streak = 0
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []
        self.scenes: RealScenes | None = None
        self.guard: Guard | None = None

    def close(self) -> None:
        """Stop physics workers, if any."""
        self.env.close()

    # -- the loop -------------------------------------------------------------------------------

    def run(self) -> PostTrainResult:
        """Go on to ``config.iterations``, or to the guard's stop, and return the best prior."""
        config = self.config
        self.directory.mkdir(parents=True, exist_ok=True)
        state = load_resumable(self.directory, config)
        self.prepare()
        if state is not None:
            self._restore(state)
        else:
            write_config(self.directory, config)
            self._guard.start(self.prior)
            self._save_prior()  # until something better: the base
        title = f"post-train {self.prior.scene_type.name}"
        started = time.perf_counter() - self.seconds
        with Progress(title, config.iterations, config.progress, self.iteration) as progress:
            while self.iteration < config.iterations and not self._stopped:
                row = self.step()
                self.seconds = time.perf_counter() - started
                self.history.append({**row, "seconds": round(self.seconds, 2)})
                last = self.iteration == config.iterations
                if self.iteration % config.guard_every == 0 or last:
                    self._check()
                if self.iteration % config.checkpoint_every == 0 or last or self._stopped:
                    self.save()
                write_log(self.directory, self.history)
                progress.update(self.iteration, row["reward"], self._guard.ratio)
        return self._finish()

    def prepare(self) -> None:
        """Draw the real scenes (kept beside the run) and make the guard."""
        config, path = self.config, self.directory / SCENES_NAME
        if path.exists():
            batch = SceneBatch.load(path)
        else:
            seed = stream_seed(config.seed, "bank")
            batch = real_scenes(self.prior, config.real_scenes, config.bank_size, seed=seed, slots=self.slots)
            _save_scenes(batch, path)
        x0 = self.prior.encode(batch.to(config.device))
        self.scenes = RealScenes.split(x0, config.guard_scenes)
        self.guard = Guard(self.scenes.heldout, config.guard_limit, stream_seed(config.seed, "guard"))

    def step(self) -> dict[str, float]:
        """One iteration: a batch of fresh scenes and its update. Returns the row for the log."""
        config = self.config
        rollout = self.rollout()
        row = {"iteration": self.iteration + 1, **_reward_figures(rollout)}
        if not bool(rollout.valid.any()):
            self._count_invalid()
        else:
            self.invalid_streak = 0
            self.last_batch = rollout.batch
            advantage = self.advantage(rollout)
            for update in range(config.updates):
                row |= self.update(rollout, advantage, update)
        self.iteration += 1
        return row

    def rollout(self) -> Rollout:
        """The scenes of the current iteration."""
        return collect(self.env, self.policy, seed=self.config.seed, iteration=self.iteration)

    def advantage(self, rollout: Rollout) -> Tensor:
        """(B,) or (B, N), as ``credit`` says."""
        config = self.config
        reward, valid = credited_reward(rollout, config.credit)
        return compute_advantages(reward, valid, baseline=config.baseline, clip=config.advantage_clip)

    def accumulate(self, rollout: Rollout, advantage: Tensor, update: int = 0) -> dict[str, float]:
        """Put both gradients into ``.grad`` and measure them apart."""
        config = self.config
        index = self.iteration * config.updates + update
        steps, scale = draw_steps(self.loss.step_weights.cpu(), config.gradient_steps, self._generator("steps", index))
        self.optimizer.zero_grad(set_to_none=True)
        policy = accumulate_policy_gradient(self.loss, rollout, advantage, steps, scale=scale)
        assert self.scenes is not None
        generator = self._generator("real", index)
        x0 = self.scenes.batch(config.regularisation_batch, generator)
        real_loss, real_norm = add_regularisation_gradient(
            self.prior, x0, config.regularisation, generator, chunk=config.chunk
        )
        return {
            "policy_loss": policy.loss,
            "policy_gradient_norm": policy.norm,
            "pretraining_loss": real_loss,
            "pretraining_gradient_norm": real_norm,
            "log_ratio": policy.log_ratio,
            "clip_fraction": policy.clip_fraction,
        }

    def update(self, rollout: Rollout, advantage: Tensor, update: int = 0) -> dict[str, float]:
        """One optimiser step; refuses a gradient that is not finite."""
        config = self.config
        row = self.accumulate(rollout, advantage, update)
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        norm = float(nn.utils.clip_grad_norm_(parameters, config.clip))
        if not all(map(_finite, (norm, row["policy_loss"], row["pretraining_loss"]))):
            self._stop_for_nan({**row, "gradient_norm": norm})
        rate = config.learning_rate * min(1.0, (self.iteration + 1) / max(1, config.warmup))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.step()
        if self.average is not None:
            self.average.update(self.prior)
        return {**row, "gradient_norm": norm, "learning_rate": rate}

    # -- guard ----------------------------------------------------------------------------------

    @property
    def _guard(self) -> Guard:
        assert self.guard is not None
        return self.guard

    @property
    def _stopped(self) -> bool:
        return self.config.guard_action == "stop" and self._guard.over_limit_at is not None

    def _check(self) -> None:
        since = self._guard.readings[-1].iteration if self._guard.readings else 0
        recent = [row["reward"] for row in self.history[since:] if _finite(row["reward"])]
        reward = sum(recent) / len(recent) if recent else float("nan")
        with _judged_weights(self.prior, self.average):
            figures = realism(self.last_batch) if recent and hasattr(self, "last_batch") else {}
            reading = self._guard.check(self.prior, self.iteration, reward, figures)
            if reading.kept:
                self._save_prior()
        self.history[-1] |= {"guard_loss": reading.loss, "guard_ratio": reading.ratio, **reading.realism}

    def _count_invalid(self) -> None:
        self.invalid_streak += 1
        if self.invalid_streak >= self.config.max_invalid:
            self.save()
            raise TrainingError(
                f"the reward {self.config.plain()['reward']!r} scored no scene in {self.invalid_streak} batches in a "
                f"row of {self.config.batch_size} (iteration {self.iteration + 1}); the warnings in the log say why, "
                "and `scene-envs check-reward` tries it on its own"
            )

    def _stop_for_nan(self, row: dict[str, float]) -> None:
        self.optimizer.zero_grad(set_to_none=True)
        figures = ", ".join(f"{name} {row[name]:.3g}" for name in ("policy_loss", "pretraining_loss", "gradient_norm"))
        raise TrainingError(
            f"iteration {self.iteration + 1} gave a gradient that is not finite ({figures}) and was not applied; "
            f"the last good checkpoint is {str(self.directory / CHECKPOINT_NAME)!r}, the best prior so far "
            f"{str(self.directory / 'prior')!r}. Lower learning_rate (now {self.config.learning_rate}) or raise "
            f"min_std (now {self.config.min_std})"
        )

    # -- files ----------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the resumable checkpoint."""
        save_checkpoint(
            self.directory / CHECKPOINT_NAME,
            {
                "config": self.config.plain(),
                "iteration": self.iteration,
                "invalid_streak": self.invalid_streak,
                "seconds": self.seconds,
                "prior": self.prior.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "average": None if self.average is None else self.average.tensors,
                "average_updates": 0 if self.average is None else self.average.updates,
                "history": self.history,
                "guard": self._guard.state(),
                "random": torch.get_rng_state(),
            },
        )

    def _restore(self, state: dict[str, Any]) -> None:
        self.prior.load_state_dict(state["prior"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.average is not None:
            self.average.tensors, self.average.updates = state["average"], state["average_updates"]
        self.iteration, self.invalid_streak = state["iteration"], state["invalid_streak"]
        self.seconds, self.history = state["seconds"], list(state["history"])
        self._guard.restore(state["guard"])
        torch.set_rng_state(state["random"])

    def _save_prior(self) -> None:
        self.prior.card = {
            **self.prior.card,
            "post_training": {
                "reward": self.config.plain()["reward"],
                "iteration": self.iteration,
                "mean_reward": self._guard.best_reward if self.iteration else None,
                "guard_ratio": self._guard.ratio,
            },
        }
        try:
            self.prior.save(self.directory / "prior")
        except OSError as error:
            raise TrainingError(
                f"could not write the prior of the run ({error}); free some space and run again"
            ) from error

    def _finish(self) -> PostTrainResult:
        rewards = [row["reward"] for row in self.history if _finite(row["reward"])]
        metrics = {
            "iterations": self.iteration,
            "seconds": round(self.seconds, 1),
            "reward": {
                "first": rewards[0] if rewards else None,
                "last": rewards[-1] if rewards else None,
                "best": self._guard.best_reward,
            },
            "guard": self._guard.summary(),
            "config": self.config.plain(),
        }
        write_metrics(self.directory, metrics)
        return PostTrainResult(ScenePrior.load(self.directory / "prior"), self.history, metrics, self.directory)

    def _generator(self, stream: str, index: int) -> Generator:
        return Generator().manual_seed(stream_seed(self.config.seed, stream, index))


class _judged_weights:
    """Context in which the prior holds its averaged weights, when there is an average."""

    def __init__(self, prior: ScenePrior, average: WeightAverage | None) -> None:
        self.prior, self.average = prior, average

    def __enter__(self) -> None:
        if self.average is not None:
            self.own = {name: p.detach().clone() for name, p in self.prior.named_parameters()}
            self.average.copy_to(self.prior)

    def __exit__(self, *_: object) -> None:
        if self.average is not None:
            with torch.no_grad():
                for name, parameter in self.prior.named_parameters():
                    parameter.copy_(self.own[name])


def _save_scenes(batch: SceneBatch, path: Path) -> None:
    try:
        batch.save(path)
    except OSError as error:
        raise TrainingError(f"could not write {str(path)!r} ({error}); free some space and run again") from error


def _reward_figures(rollout: Rollout) -> dict[str, float]:
    reward = rollout.reward[rollout.valid]
    counts = rollout.batch.counts.float()
    figures = {
        "reward": float(reward.mean()) if len(reward) else float("nan"),
        "reward_std": float(reward.std(unbiased=False)) if len(reward) else float("nan"),
        "valid_fraction": float(rollout.valid.float().mean()),
        "objects": float(counts.mean()),
    }
    for name, term in rollout.terms.items():
        if len(reward):
            figures[f"term_{name}"] = float(term[rollout.valid].mean())
    return figures


def _finite(value: float) -> bool:
    return value == value and abs(value) != float("inf")
