"""The denoising MDP (Black et al. 2024, Sec. 4.2): one batched pure-torch core, which every adapter wraps.

State (x_t, t, prompt), action x_{t-1}, transition the identity, reward at t = 0 only. In ``noise`` mode the action is
the noise of the prior's own reverse step instead, so that actions from N(0, I) reproduce the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.scoring import EnvPrompts, RewardScorer, Score, prior_device
from scene_envs.envs.settings import DenoisingSettings, takes
from scene_envs.envs.spaces import (
    STATE_BOUND,
    ResetNeededError,
    check_action,
    check_slots,
    occupied,
    resolve_scene_and_prior,
)
from scene_envs.errors import InvalidInputError
from scene_envs.protocols import EncodedPriorLike
from scene_envs.scene import SceneBatch

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]


@dataclass(frozen=True)
class StepResult:
    """Result of one step of the B episodes of a core.

    Attributes:
        reward: (B,) float32; 0 before the last step and where ``valid`` is False.
        valid: (B,) bool; False where the reward could not score the finished scene.
        terminated: (B,) bool, on the CPU.
        terms: named (B,) float32 of the reward; 0 before the last step.
        score: the full verdict, when all B episodes ended in this step; else None.
        batch: the B finished scenes, likewise.
    """

    reward: Tensor
    valid: Tensor
    terminated: BoolArray
    terms: dict[str, Tensor]
    score: Score | None = None
    batch: SceneBatch | None = None


def take_rows(x: Tensor, rows: IntArray) -> Tensor:
    """``x[rows]`` without a copy when ``rows`` are all of them."""
    return x if len(rows) == x.shape[0] else x[torch.from_numpy(rows).to(x.device)]


def replace_rows(x: Tensor, rows: IntArray, values: Tensor) -> Tensor:
    """A new tensor: ``x`` with ``rows`` (ascending) set to ``values``."""
    if len(rows) == x.shape[0]:
        return values
    changed = x.clone()
    changed[torch.from_numpy(rows).to(x.device)] = values
    return changed


class DenoisingCore:
    """B denoising episodes side by side, which may be at different steps.

    Known entries (fixed welded slots, constant features) are clamped to their values after every action, and
    scenes are kept within ±10. An episode's x_T comes from its own NumPy generator, so it does not depend on
    the size of the batch.

    Args:
        num_envs: B.
        **settings: fields of :class:`~scene_envs.envs.settings.DenoisingSettings`; ``prompt`` and ``guidance`` as for
            :class:`~scene_envs.envs.scoring.EnvPrompts`.

    Attributes:
        features: D, numbers per slot that the prior denoises; the scene type's, except for priors with other rotations.

    Raises:
        InvalidInputError, UnknownNameError: an argument is outside what is accepted.

    >>> core = DenoisingCore(2, num_steps=1, action_mode="noise")
    >>> core.reset([np.random.default_rng(seed) for seed in (0, 1)])
    >>> result = core.step(torch.zeros(2, 34, 20))
    >>> result.terminated.tolist(), tuple(result.reward.shape), result.batch
    ([True, True], (2,), SceneBatch('dimsum_table', (2, 34, 20)))
    """

    @takes(DenoisingSettings)
    def __init__(self, num_envs: int, **settings: Any) -> None:
        if not isinstance(num_envs, int) or num_envs < 1:
            raise InvalidInputError(f"num_envs={num_envs!r}: at least one environment is needed")
        chosen = DenoisingSettings(**settings)
        self.num_envs = num_envs
        self.scene_type, self.prior = resolve_scene_and_prior(chosen.scene, chosen.prior, chosen.device)
        self.slots = check_slots(self.scene_type, chosen.slots)
        prior = self.prior
        self.features = prior.features if isinstance(prior, EncodedPriorLike) else self.scene_type.features
        self.action_mode = chosen.action_mode
        self.max_action = float(chosen.max_action)
        self.table = self.prior.step_table(chosen.num_steps)
        self.num_steps = len(self.table)
        self.device = prior_device(self.prior)
        self.prompting = EnvPrompts(self.prior, chosen.prompt, chosen.guidance, self.slots)
        self.scorer = RewardScorer(chosen.reward, chosen.workers, chosen.physics, prompted=self.prompting.given)
        self.term_names = self.scorer.probe(
            SceneBatch.empty(self.scene_type, 1, self.slots), [""] if self.prompting.given else None
        )
        # timestep of step i, with the clean scene's 0 at the end
        self._schedule = np.append(self.table.timesteps.cpu().numpy(), 0).astype(np.int64)
        self._steps: IntArray = np.full(num_envs, -1, dtype=np.int64)  # -1: never reset
        self._x = torch.zeros(num_envs, self.slots, self.features, device=self.device)
        self._prompts = [""] * num_envs
        self._read_prompts()

    @property
    def x(self) -> Tensor:
        """(B, N, D) current normalised scenes; never written in place."""
        return self._x

    @property
    def steps(self) -> IntArray:
        """(B,) steps taken in each episode."""
        return self._steps.copy()

    @property
    def timesteps(self) -> IntArray:
        """(B,) current diffusion timesteps, 0 when finished."""
        return self._schedule[self._steps]

    @property
    def first_timestep(self) -> int:
        """T, the timestep every episode starts at."""
        return int(self._schedule[0])

    @property
    def finished(self) -> BoolArray:
        """(B,) bool: episodes at t = 0."""
        return self._steps == self.num_steps

    def scenes(self) -> SceneBatch:
        """The current scenes, decoded on the device of the prior: rotations in SO(3), arg-max categories."""
        if isinstance(self.prior, EncodedPriorLike) and self.features != self.scene_type.features:
            return self.prior.decode(self._x)
        return SceneBatch.from_tensor(self._x, self.scene_type, normalised=self.prior.normalizer)

    @property
    def prompts(self) -> tuple[str, ...] | None:
        """The prompt of each episode, or None without prompts."""
        return tuple(self._prompts) if self.prompting.given else None

    def observation(self) -> dict[str, Tensor]:
        """``scene`` (B, N, D) float32, ``timestep`` (B, 1) int64, ``object_mask`` (B, N) int8; all fresh tensors.

        With a prior that reads prompts also ``prompt`` (B, L) int64 token indices, 0 being padding.
        """
        observed = {
            "scene": self._x.clone(),
            "timestep": self.column(self.timesteps),
            "object_mask": occupied(self._x, self.scene_type),
        }
        if self._tokens is not None:
            observed["prompt"] = self._tokens.clone()
        return observed

    def column(self, values: np.ndarray) -> Tensor:
        """One value (B,) per episode as a column (B, 1) on the device; where all are equal, nothing is copied there."""
        column = torch.from_numpy(values).unsqueeze(-1)
        if (values == values[0]).all():
            return torch.full(column.shape, values[0].item(), dtype=column.dtype, device=self.device)
        return column.to(self.device)

    def info(self, result: StepResult | None = None) -> dict[str, np.ndarray]:
        """(B,) numbers: step, timestep, objects, reward_valid and ``term_<name>`` for each term of the reward.

        Args:
            result: result of the step just taken; None after a reset.
        """
        terms = result.terms if result is not None else dict.fromkeys(self.term_names)
        valid = np.ones(self.num_envs, np.int64) if result is None else result.valid.cpu().numpy().astype(np.int64)
        info = {
            "step": self.steps,
            "timestep": self.timesteps,
            "objects": occupied(self._x, self.scene_type).sum(dim=-1).cpu().numpy(),
            "reward_valid": valid,
        }
        for name, term in terms.items():
            info[f"term_{name}"] = np.zeros(self.num_envs) if term is None else term.cpu().numpy().astype(np.float64)
        return info

    @torch.no_grad()
    def reset(
        self, rngs: Sequence[np.random.Generator], mask: BoolArray | None = None, prompts: Sequence[str] | None = None
    ) -> None:
        """Start new episodes.

        Args:
            rngs: one NumPy generator per environment; each reset environment draws one seed from its own, and then
                its prompt, if there are several.
            mask: (B,) bool, which environments; None means all.
            prompts: B prompts, in place of drawn ones; those of environments that are not reset are ignored.
        """
        rows = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        if len(rows) == 0:
            return
        seeds = [int(rngs[row].integers(2**63)) for row in rows.tolist()]
        noises = [torch.Generator(self.device).manual_seed(seed) for seed in seeds]
        starts = torch.cat([self.prior.initial(1, self.slots, noise) for noise in noises])
        self._x = replace_rows(self._x, rows, starts.clamp(-STATE_BOUND, STATE_BOUND))
        self._steps[rows] = 0
        if self.prompting.given:
            for row in rows.tolist():
                self._prompts[row] = self.prompting.draw(rngs[row]) if prompts is None else prompts[row]
        self._read_prompts()

    def _read_prompts(self) -> None:
        """Set the token indices of the prompts; the network encodes them when the encoding is first needed."""
        has_reader = self.prompting.reader is not None
        self._tokens = self.prompting.read(self._prompts).to(self.device) if has_reader else None
        self._text: tuple[Tensor, ...] | None = None

    @torch.no_grad()
    def step(self, action: Any, active: BoolArray | None = None) -> StepResult:
        """Take one denoising step in every active environment.

        Args:
            action: (B, N, D) array or tensor; values beyond ±max_action are clipped.
            active: (B,) bool; None means all. Rows of inactive environments are ignored but must be finite.

        Raises:
            ResetNeededError: an active episode has ended or never began.
            InvalidInputError: the action has the wrong shape or is not finite.
        """
        shape = (self.num_envs, self.slots, self.features)
        given = check_action(action, shape, ("environment", "slot", "feature")).to(self.device)
        rows = np.arange(self.num_envs) if active is None else np.flatnonzero(active)
        stopped = rows[(self._steps[rows] < 0) | (self._steps[rows] >= self.num_steps)]
        if len(stopped):
            fresh = bool((self._steps[stopped] < 0).any())
            what = "was never reset" if fresh else f"ended after its {self.num_steps} steps"
            raise ResetNeededError(f"the episode of environment {int(stopped[0])} {what}; call reset() first")
        given = given.clamp(-self.max_action, self.max_action)
        for step in np.unique(self._steps[rows]):
            group = rows[self._steps[rows] == step]
            moved = self._transition(take_rows(self._x, group), take_rows(given, group), int(step), group)
            self._x = replace_rows(self._x, group, moved)
        self._steps[rows] += 1
        return self._judge(rows[self.finished[rows]])

    def _transition(self, x_t: Tensor, action: Tensor, step: int, rows: IntArray) -> Tensor:
        if self.action_mode == "noise":
            reader = self.prompting.reader
            if reader is None or self._tokens is None:
                reverse = self.prior.transition(x_t, step, self.table)
            else:
                if self._text is None:  # encoded once per reset
                    self._text = tuple(reader.encode_tokens(self._tokens))
                text = tuple(take_rows(part, rows) for part in self._text)
                reverse = reader.transition(x_t, step, self.table, text=text, guidance=self.prompting.guidance)
            action = reverse.from_noise(action)
        return self.prior.clamp(action).clamp(-STATE_BOUND, STATE_BOUND)

    def _judge(self, ended: IntArray) -> StepResult:
        count, device = self.num_envs, self.device
        reward = torch.zeros(count, device=device)
        valid = torch.ones(count, dtype=torch.bool, device=device)
        terms = {name: torch.zeros(count, device=device) for name in self.term_names}
        terminated = np.zeros(count, dtype=np.bool_)
        if len(ended) == 0:
            return StepResult(reward, valid, terminated, terms)
        terminated[ended] = True
        together = len(ended) == count
        batch = self.scenes() if together else self.scenes()[torch.from_numpy(ended)]
        prompts = None if self.prompts is None else [self._prompts[row] for row in ended.tolist()]
        score = self.scorer(batch, prompts)
        reward = replace_rows(reward, ended, score.value)
        valid = replace_rows(valid, ended, score.valid)
        for name in terms.keys() & score.terms.keys():
            terms[name] = replace_rows(terms[name], ended, score.terms[name])
        if not together:
            return StepResult(reward, valid, terminated, terms)
        return StepResult(reward, valid, terminated, terms, score, batch)

    def close(self) -> None:
        """Stop physics workers, if any."""
        self.scorer.close()
