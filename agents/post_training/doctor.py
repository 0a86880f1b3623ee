"""Doctor: checks of a post-training run on one batch, before it starts."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase

from agents.configuration.composition import changed
from agents.post_training.algorithms.base import final_reward, gradient_norm
from agents.post_training.algorithms.ddpo import DDPOSFLoss, accumulate_policy_gradient
from agents.post_training.learner import Learner
from agents.post_training.settings import GuidanceDistillationSettings, PostTrainConfig
from agents.post_training.trainer import PostTrainer
from agents.priors.prior import ScenePrior

if TYPE_CHECKING:
    from rich.console import RenderableType

MAX_RATIO, MIN_RATIO = 30.0, 1 / 30.0
"""Ratios of policy to regularisation gradient norm beyond which one of the two gradients dominates."""
MAX_STEP_SHARE = 0.7
"""Share of the squared policy gradient above which one step dominates the others."""


@dataclass(frozen=True)
class StepRow:
    """One step of the chain."""

    step: int  # index in the step table
    timestep: int  # at which the step starts
    std: float  # smallest standard deviation over random entries, normalised units
    weight: float  # in the policy gradient; 0 leaves the step out
    gradient_norm: float  # of this step's policy gradient alone; 0 if the step is left out


@dataclass(frozen=True)
class DoctorReport:
    """Findings of the doctor."""

    log_ratio: float  # largest |log p_now - log p_sampling|; exactly 0 if sampler and loss agree
    steps: list[StepRow]
    reward_mean: float  # of one batch, as the next three
    reward_std: float
    reward_min: float
    reward_max: float
    valid_fraction: float  # share of scenes that were scored
    policy_gradient_norm: float  # of the score-function part
    pretraining_gradient_norm: float  # of the regularisation, its coefficient included
    sampling_seconds: float  # sampling and scoring one batch
    update_seconds: float  # all updates of a batch
    iterations: int  # of the run, for the estimate of its duration
    advice: list[str] = field(default_factory=list)  # recommended changes in words

    @property
    def gradient_ratio(self) -> float:
        """Policy gradient over regularisation; infinite without regularisation."""
        if self.pretraining_gradient_norm == 0:
            return float("inf")
        return self.policy_gradient_norm / self.pretraining_gradient_norm

    def metrics(self) -> dict[str, Any]:
        """All findings as JSON-able values."""
        return {**vars(self), "steps": [vars(row) for row in self.steps], "gradient_ratio": self.gradient_ratio}

    def __rich__(self) -> RenderableType:
        """One screen for a terminal."""
        from rich.columns import Columns
        from rich.console import Group
        from rich.panel import Panel
        from rich.table import Table

        table = Table("step", "t", "sigma", "weight", "|gradient|", box=None, header_style="bold", pad_edge=False)
        for row in self.steps:
            style = "" if row.weight > 0 else "dim"
            norm = f"{row.gradient_norm:.3g}" if row.weight > 0 else "out"
            table.add_row(str(row.step), str(row.timestep), f"{row.std:.4f}", f"{row.weight:.2f}", norm, style=style)
        facts = Table(box=None, show_header=False, pad_edge=False)
        length = self.iterations * (self.sampling_seconds + self.update_seconds) / 60
        for name, value in (
            *([("log-ratio at the start", f"{self.log_ratio:.3g}")] if self.steps else []),
            ("reward", f"{self.reward_mean:.3g} ± {self.reward_std:.3g}"),
            ("reward range", f"{self.reward_min:.3g} … {self.reward_max:.3g}"),
            ("valid scenes", f"{self.valid_fraction:.0%}"),
            ("policy gradient", f"{self.policy_gradient_norm:.3g}"),
            ("regularisation gradient", f"{self.pretraining_gradient_norm:.3g}"),
            ("their ratio", f"{self.gradient_ratio:.3g}"),
            ("one batch, its updates", f"{self.sampling_seconds:.1f} s, {self.update_seconds:.1f} s"),
            (f"{self.iterations} iterations", f"about {length:.0f} min"),
        ):
            facts.add_row(name, f"[bold]{value}")
        advice = "\n".join(f"[yellow]• {line}" for line in self.advice) or "[green]Nothing to change."
        return Panel(
            Group(Columns([table, facts] if self.steps else [facts], padding=(0, 6)), "", advice),
            title="post-training doctor",
            expand=False,
        )


def diagnose(config: PostTrainConfig, *, prior: ScenePrior | None = None) -> DoctorReport:
    """Examine a configuration with one batch of scenes; nothing is trained or written. ``prior`` replaces the one that
    ``config.prior`` names.
    """
    with TemporaryDirectory() as scratch:
        real = config.regularisation
        bank = min(real.bank_size, config.guard.scenes + 4 * real.batch_size)
        small = changed(config, {"output": str(Path(scratch) / "run"), "regularisation.bank_size": bank})
        with closing(PostTrainer(small, prior=prior)) as trainer:
            return _examine(trainer)


def _examine(trainer: PostTrainer) -> DoctorReport:
    trainer.prepare()
    learner = trainer.learner
    started = time.perf_counter()
    batch = learner.rollout(iteration=0)
    sampled = time.perf_counter()
    row = learner.accumulate(learner.write_advantage(batch), trainer.scenes, index=0)
    further, updated = trainer.config.algorithm.optimiser_steps - 1, time.perf_counter()
    if further:  # the first one may do more
        learner.accumulate(batch, trainer.scenes, index=1)
    repeated = time.perf_counter() - updated
    steps, largest = _step_rows(learner, batch)
    reward, valid = final_reward(batch[:, -1])
    scored = reward[valid].double()
    scored = scored if len(scored) else scored.new_full((1,), float("nan"))
    report = DoctorReport(
        log_ratio=max(largest, row.get("log_ratio", 0.0)),
        steps=steps,
        reward_mean=float(scored.mean()),
        reward_std=float(scored.std(unbiased=False)),
        reward_min=float(scored.min()),
        reward_max=float(scored.max()),
        valid_fraction=float(valid.double().mean()),
        policy_gradient_norm=row["policy_gradient_norm"],
        pretraining_gradient_norm=row["pretraining_gradient_norm"],
        sampling_seconds=sampled - started,
        update_seconds=updated - sampled + further * repeated,
        iterations=trainer.config.iterations,
    )
    return replace(report, advice=_advice(report, trainer.config))


def _step_rows(learner: Learner, batch: TensorDictBase) -> tuple[list[StepRow], float]:
    """The sigma table, and the largest log-ratio over the steps in the gradient; nothing without such steps."""
    loss = learner.algorithm.loss
    rows: list[StepRow] = []
    largest = 0.0
    if not isinstance(loss, DDPOSFLoss):
        return rows, largest
    timesteps = learner.policy.table.timesteps.tolist()
    for step, weight in enumerate(loss.step_weights.tolist()):
        norm = 0.0
        if weight > 0:
            learner.optimizer.zero_grad(set_to_none=True)
            found = accumulate_policy_gradient(loss, batch, [step])
            norm, largest = gradient_norm(learner.parameters), max(largest, found.columns["log_ratio"])
        rows.append(StepRow(step, timesteps[step], float(learner.stds[step]), weight, norm))
    learner.optimizer.zero_grad(set_to_none=True)
    return rows, largest


def _advice(report: DoctorReport, config: PostTrainConfig) -> list[str]:
    algorithm, weight = config.algorithm, config.regularisation.weight or 0.0
    advice = []
    if report.log_ratio != 0:
        advice.append(
            f"The log-ratio before the first update is {report.log_ratio:.2g}, not 0: "
            "sampler and loss disagree about the policy."
        )
    if report.valid_fraction < 1:
        advice.append(f"{1 - report.valid_fraction:.0%} of the scenes have no valid reward; see the log for why.")
    rewarded = not isinstance(algorithm, GuidanceDistillationSettings)
    if rewarded and report.valid_fraction > 0 and not report.reward_std > 0:
        advice.append("All rewards are equal: there is nothing to learn from. Use a graded reward or more scenes.")
    if rewarded and report.reward_std > 0 and report.policy_gradient_norm == 0:
        advice.append(
            "The rewards differ between prompts but not within any: there is nothing to learn. Raise scenes_per_prompt "
            f"from {algorithm.scenes_per_prompt}, or use a reward that differs between scenes of one prompt."
            if config.prompt is not None
            else "The rewards differ, but no advantage does: there is nothing to learn. Another algorithm.credit may "
            "help."
        )
    if weight > 0 and report.policy_gradient_norm > 0:
        if report.gradient_ratio < MIN_RATIO:
            advice.append(
                f"Regularisation dominates the policy gradient (ratio {report.gradient_ratio:.2g}): lower "
                f"regularisation.weight from {weight:g}."
            )
        if report.gradient_ratio > MAX_RATIO:
            advice.append(
                f"The policy gradient dominates the regularisation (ratio {report.gradient_ratio:.2g}): raise "
                f"regularisation.weight from {weight:g}, or expect the guard to stop the run."
            )
    if not report.steps:
        return advice
    worst = max(report.steps, key=lambda row: row.gradient_norm)
    total = sum(row.gradient_norm**2 for row in report.steps)
    many = sum(row.weight > 0 for row in report.steps) > 2
    if many and total > 0 and worst.gradient_norm**2 > MAX_STEP_SHARE * total:
        advice.append(
            f"Step {worst.step} (sigma {worst.std:.3g}) alone is {worst.gradient_norm**2 / total:.0%} of the squared "
            f"policy gradient: raise algorithm.min_std."
        )
    return advice
