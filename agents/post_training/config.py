"""All knobs of one post-training run."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

from agents.post_training.prompts import check_prompt
from rewards import reward_name
from scene_envs.errors import InvalidInputError

CREDITS = ("auto", "scene", "object")
RESUMABLE = ("iterations", "output", "workers", "progress", "checkpoint_every")
"""Fields that may change between a run and its continuation."""


@dataclass
class PostTrainConfig:
    """One post-training run.

    The gradient that AdamW sees is that of

        - step_scale * sum over gradient steps of mean over scenes of  A * log p(x_{t-1} | x_t)
        + regularisation * pretraining loss on real scenes

    with ``step_scale = steps with weight > 0 / gradient_steps``, log p reduced over a scene's entries as
    ``log_prob_reduction`` says, and the pretraining loss a mean over scenes and entries. ``regularisation`` means
    nothing without these reductions: with ``"sum"`` the same balance needs one larger by the number of random
    entries of a scene.

    Attributes:
        prior: the prior to start from, a shipped name or a path.
        reward: registered name, or a mapping with ``name`` and settings.
        output: run directory; an interrupted run found there goes on where it stopped.
        seed: of x_T, the chain's noise, the steps drawn and the real scenes.
        iterations: policy updates, that is batches of fresh scenes.
        batch_size: scenes sampled per iteration.
        num_steps: denoising steps per scene.
        gradient_steps: how many of the eligible steps are drawn into the gradient per iteration.
        min_std: steps with a smaller sigma (normalised units) stay out of the gradient.
        skip_first: fraction of the chain, from its noisy end, that stays out of the gradient.
        step_weighting: ``"uniform"``, or weights proportional to a step's ``"std"`` or ``"variance"``.
        log_prob_reduction: ``"mean"`` or ``"sum"`` of log p over the random entries of a scene.
        clip_epsilon: half-width of the probability-ratio clip (DDPO-IS); null for the score function (DDPO-SF).
        updates: optimiser steps per batch; more than one needs ``clip_epsilon``.
        credit: ``"scene"`` gives every slot the scene's advantage, ``"object"`` its own (rewards with ``per_object``),
            ``"auto"`` takes ``"object"`` where the reward allows it.
        baseline: ``"leave_one_out"`` or ``"mean"``.
        advantage_clip: advantages are kept within plus and minus this.
        regularisation: coefficient of the pretraining loss on real scenes.
        regularisation_batch: real scenes per update.
        real_scenes: ``"grammar"``, or the directory of a dataset.
        prompt: what the scenes should hold, for priors that read prompts: one text, a list of texts, ``"data"`` for the
            prompts of the real scenes, or ``"grammar"`` for descriptions of the grammar's; null for anything.
        guidance: weight of classifier-free guidance in the policy, 0 for none; needs a prompt.
        scenes_per_prompt: scenes of a batch that share a prompt; advantages are taken among them.
        bank_size: how many real scenes are drawn (grammar) or read (dataset), the held-out ones included.
        learning_rate: of AdamW.
        warmup: updates over which the learning rate rises linearly.
        weight_decay: decoupled weight decay of AdamW.
        clip: largest norm of the summed gradient.
        ema: decay of the weight average that is evaluated and saved; 0 takes the weights themselves.
        slots: slots per scene; null means as many as the prior was trained on.
        chunk: scenes per forward and backward pass; null takes the whole batch at once.
        guard_every: iterations between guard checks.
        guard_scenes: held-out real scenes of the guard.
        guard_limit: largest held-out loss, as a ratio to the base prior's, of a checkpoint worth keeping.
        guard_action: ``"report"`` goes on beyond the limit, ``"stop"`` ends the run there.
        checkpoint_every: iterations between resumable checkpoints.
        max_invalid: consecutive batches without one valid reward after which the run stops.
        workers: physics worker processes; 0 computes rewards in this process.
        device: torch device.
        progress: ``"bar"``, ``"lines"`` or ``"none"``.
    """

    prior: str = "dimsum_table_continuous"
    reward: Any = "object_count"
    output: str = "runs/post-train"
    seed: int = 0
    iterations: int = 60
    batch_size: int = 48
    num_steps: int = 25
    gradient_steps: int = 8
    min_std: float = 0.03
    skip_first: float = 0.0
    step_weighting: str = "uniform"
    log_prob_reduction: str = "mean"
    clip_epsilon: float | None = None
    updates: int = 1
    credit: str = "auto"
    baseline: str = "leave_one_out"
    advantage_clip: float = 5.0
    regularisation: float = 0.5
    regularisation_batch: int = 48
    real_scenes: str = "grammar"
    prompt: Any = None
    guidance: float = 0.0
    scenes_per_prompt: int = 8
    bank_size: int = 4096
    learning_rate: float = 5e-5
    warmup: int = 0
    weight_decay: float = 0.0
    clip: float = 1.0
    ema: float = 0.0
    slots: int | None = None
    chunk: int | None = None
    guard_every: int = 5
    guard_scenes: int = 256
    guard_limit: float = 1.5
    guard_action: str = "report"
    checkpoint_every: int = 10
    max_invalid: int = 3
    workers: int = 0
    device: str = "cpu"
    progress: str = "bar"

    def __post_init__(self) -> None:
        for name in ("iterations", "num_steps", "gradient_steps", "updates", "regularisation_batch", "guard_every"):
            self._at_least(name, 1)
        self._at_least("batch_size", 2)
        self._at_least("scenes_per_prompt", 2)
        self.prompt = list(self.prompt) if isinstance(self.prompt, tuple) else self.prompt
        check_prompt(self.prompt, self.guidance)
        self._at_least("guard_scenes", 1)
        self._at_least("checkpoint_every", 1)
        self._at_least("max_invalid", 1)
        for name in ("learning_rate", "clip", "guard_limit", "advantage_clip", "min_std"):
            if not getattr(self, name) > 0:
                raise InvalidInputError(f"{name}={getattr(self, name)} must be positive")
        if self.regularisation < 0:
            raise InvalidInputError(f"regularisation={self.regularisation} must not be negative")
        if not 0 <= self.ema < 1 or not 0 <= self.skip_first < 1:
            raise InvalidInputError(f"ema={self.ema} and skip_first={self.skip_first} must lie in [0, 1)")
        self._one_of("credit", CREDITS)
        self._one_of("guard_action", ("report", "stop"))
        self._one_of("progress", ("bar", "lines", "none"))
        if self.updates > 1 and self.clip_epsilon is None:
            raise InvalidInputError(f"updates={self.updates} per batch needs clip_epsilon, such as 1e-4")
        if self.bank_size < self.guard_scenes + 1:
            raise InvalidInputError(
                f"bank_size={self.bank_size} must exceed guard_scenes={self.guard_scenes}, which are held out of it"
            )

    def _at_least(self, name: str, low: int) -> None:
        if getattr(self, name) < low:
            raise InvalidInputError(f"{name}={getattr(self, name)} must be at least {low}")

    def _one_of(self, name: str, known: tuple[str, ...]) -> None:
        if getattr(self, name) not in known:
            raise InvalidInputError(f"{name}={getattr(self, name)!r} is not known; use one of {', '.join(known)}")

    def plain(self) -> dict[str, Any]:
        """As numbers, strings and lists; a reward given as an object becomes its name."""
        state = asdict(self) if _is_plain(self.reward) else {**_shallow(self), "reward": reward_name(self.reward)}
        return state


def _shallow(config: PostTrainConfig) -> dict[str, Any]:
    return {field.name: getattr(config, field.name) for field in fields(config)}


def _is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | int | float | bool)
