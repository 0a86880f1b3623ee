"""A prior as a torchrl policy over the denoising MDP: it draws x_{t-1} and knows its log-probability."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Generator, Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.protocols import PriorLike, StepTableLike


def gaussian_log_prob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Log-density of independent normals, summed over features; entries with std 0 are left out.

    Args:
        x: (B, N, D) where it is evaluated.
        mean: (B, N, D).
        std: (N, D), not negative. An entry with std 0 is certain: it carries no probability and no gradient.

    Returns:
        (B, N) nats, one sum per slot.

    >>> x, std = torch.zeros(1, 1, 2), torch.tensor([[1.0, 0.0]])
    >>> round(float(gaussian_log_prob(x, torch.zeros(1, 1, 2), std)), 4)
    -0.9189
    """
    random = std > 0
    safe = torch.where(random, std, torch.ones_like(std))
    z = (x - mean) / safe
    log_density = -0.5 * z.square() - safe.log() - 0.5 * math.log(2 * math.pi)
    return torch.where(random, log_density, torch.zeros_like(log_density)).sum(dim=-1)


class DenoisingPolicy(TensorDictModuleBase):
    """The reverse chain of a prior as a policy: action x_{t-1} ~ p(. | x_t), state (x_t, t).

    Works as a torchrl policy (``env.rollout(n, policy)``): reads ``scene`` (B, N, D) and ``timestep`` (B, 1),
    writes ``action`` (B, N, D) and ``action_log_prob`` (B,), the latter summed over all random entries.

    Args:
        prior: what denoises; its parameters are the policy's.
        num_steps: steps of the chain, as in the environment.
        chunk: scenes denoised at once, in sampling and in log-probabilities alike; None takes all.

    >>> from agents.prior import tiny_prior
    >>> from scene_envs.denoising_torchrl import DenoisingTorchRLEnv
    >>> prior = tiny_prior()
    >>> env = DenoisingTorchRLEnv(2, prior=prior, num_steps=4)
    >>> env.rollout(4, DenoisingPolicy(prior, 4))["action_log_prob"].shape
    torch.Size([2, 4])
    """

    in_keys = ["scene", "timestep"]  # noqa: RUF012  (torchrl reads lists)
    out_keys = ["action", "action_log_prob"]  # noqa: RUF012

    def __init__(self, prior: PriorLike, num_steps: int, *, chunk: int | None = None) -> None:
        super().__init__()
        if chunk is not None and chunk < 1:
            raise InvalidInputError(f"chunk={chunk}: at least one scene must be denoised at a time")
        self.prior = prior
        self.chunk = chunk
        self.table: StepTableLike = prior.step_table(num_steps)
        self._step_of = {int(t): step for step, t in enumerate(self.table.timesteps.tolist())}

    def __len__(self) -> int:
        return len(self.table)

    def step_of(self, timestep: int) -> int:
        """Index in the step table of a timestep that the chain visits."""
        if timestep not in self._step_of:
            raise InvalidInputError(
                f"timestep {timestep} is not one of the {len(self)} this policy visits; "
                "give environment and policy the same num_steps"
            )
        return self._step_of[timestep]

    def distribution(self, x_t: Tensor, step: int) -> tuple[Tensor, Tensor]:
        """Mean (B, N, D) and std (N, D) of x_{t-1}; differentiable in the prior's parameters."""
        parts = [self.prior.posterior(part, step, self.table) for part in x_t.split(self.chunk or x_t.shape[0])]
        return torch.cat([mean for mean, _ in parts]), parts[0][1]

    def draw(self, x_t: Tensor, step: int, generator: Generator | None = None) -> tuple[Tensor, Tensor]:
        """An action (B, N, D) and its log-probability per slot (B, N), without gradients."""
        with torch.no_grad():
            mean, std = self.distribution(x_t, step)
            noise = torch.randn(mean.shape, generator=generator, device=mean.device)
            action = mean + std * noise
            return action, gaussian_log_prob(action, mean, std)

    def log_prob(self, x_t: Tensor, step: int, action: Tensor) -> Tensor:
        """(B, N) log-probability per slot of ``action``; states and actions are taken as constants."""
        mean, std = self.distribution(x_t.detach(), step)
        return gaussian_log_prob(action.detach(), mean, std)

    def random_entries(self, slots: int) -> int:
        """How many of the N·D entries of a scene the chain draws; the others are known."""
        return int((self._std_maps(slots)[0] > 0).sum())

    def stds(self, slots: int) -> Tensor:
        """(S,) smallest sigma of every step over its random entries, normalised units; 0 where none is random."""
        smallest = [
            std[std > 0].amin() if bool((std > 0).any()) else std.new_zeros(()) for std in self._std_maps(slots)
        ]
        return torch.stack(smallest)

    @torch.no_grad()
    def _std_maps(self, slots: int) -> list[Tensor]:
        x = self.prior.initial(1, slots, None)
        return [self.prior.posterior(x, step, self.table)[1] for step in range(len(self))]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write an action and its log-probability; rows may be at different steps."""
        scene, timestep = tensordict["scene"], tensordict["timestep"].squeeze(-1)
        action = scene.clone()
        log_prob = torch.zeros(scene.shape[:-2], device=scene.device)
        for t in timestep.unique().tolist():
            rows = timestep == t
            if t == 0:  # a finished episode that waits for its reset
                continue
            action[rows], per_slot = self.draw(scene[rows], self.step_of(t))
            log_prob[rows] = per_slot.sum(dim=-1)
        tensordict.set("action", action)
        tensordict.set("action_log_prob", log_prob)
        return tensordict


def gradient_weights(
    stds: Tensor, *, min_std: float = 1e-2, skip_first: float = 0.0, weighting: str = "uniform"
) -> Tensor:
    """(S,) weight of every step in the policy gradient; 0 leaves a step out.

    A step whose sigma is below ``min_std`` is sampled with that sigma but has no part in the gradient: its
    log-density is so steep that millimetres of noise drown the reward. (Flooring the sigma of the *sampler*
    instead would add that much noise to every finished scene.)

    Args:
        stds: (S,) sigma of every step, normalised units.
        min_std: smallest sigma of a step in the gradient.
        skip_first: fraction of the chain, from its noisy end, that stays out of the gradient.
        weighting: ``"uniform"``, ``"std"`` (proportional to sigma) or ``"variance"`` (to sigma squared);
            weights of the steps taken have mean 1.

    >>> gradient_weights(torch.tensor([0.6, 0.2, 0.005, 0.0])).tolist()
    [1.0, 1.0, 0.0, 0.0]
    """
    powers = {"uniform": 0.0, "std": 1.0, "variance": 2.0}
    if weighting not in powers:
        raise InvalidInputError(f"step_weighting={weighting!r} is not known; use one of {', '.join(powers)}")
    if min_std <= 0:
        raise InvalidInputError(f"min_std={min_std} must be positive: the last step is deterministic")
    taken = stds >= min_std
    taken[: round(skip_first * len(stds))] = False
    if not bool(taken.any()):
        raise InvalidInputError(
            f"no step is left in the policy gradient: min_std={min_std}, skip_first={skip_first}, "
            f"and the sigmas of the chain are {[round(float(s), 4) for s in stds]}"
        )
    weight = torch.where(taken, stds ** powers[weighting], torch.zeros_like(stds))
    return weight / weight[taken].mean()
