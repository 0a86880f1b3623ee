"""The reverse chain of a prior as a torchrl policy, with samples of x_{t-1} and their log-probabilities."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Generator, Tensor

from agents.diffusion import ReverseStep
from agents.diffusion.reverse_steps import MixedStep, concatenate_steps
from agents.networks.text import Text
from scene_envs.errors import InvalidInputError
from scene_envs.protocols import PriorLike, PromptedPriorLike, StepTableLike


class DenoisingPolicy(TensorDictModuleBase):
    """The reverse chain of a prior as a policy: action x_{t-1} ~ p(. | x_t), state (x_t, t, prompt).

    Works as a torchrl policy (``env.rollout(n, policy)``). It reads ``scene`` (B, N, D), ``timestep`` (B, 1) and, if
    the prior reads prompts, ``prompt`` (B, L). It writes ``action`` (B, N, D), ``slot_log_prob`` (B, N), which is
    summed over the random entries of each slot, and ``action_log_prob`` (B,), which is summed over all.

    Args:
        prior: prior that denoises; its parameters are the policy's.
        num_steps: number of steps of the chain, as in the environment.
        chunk: number of scenes denoised at once, for sampling and for log-probabilities; None takes all.
        guidance: weight w of classifier-free guidance; if it is not 0, the guided chain is the policy.
        independent: whether slots draw their categories independently, so that log-probabilities are exact; False draws
            as ``prior.sample`` does.

    >>> from agents.priors.testing import tiny_prior
    >>> from scene_envs.envs import DenoisingTorchRLEnv
    >>> prior = tiny_prior()
    >>> env = DenoisingTorchRLEnv(2, prior=prior, num_steps=4)
    >>> env.rollout(4, DenoisingPolicy(prior, 4))["action_log_prob"].shape
    torch.Size([2, 4])
    """

    in_keys = ["scene", "timestep"]  # noqa: RUF012  (torchrl reads lists)
    out_keys = ["action", "action_log_prob", "slot_log_prob"]  # noqa: RUF012

    def __init__(
        self,
        prior: PriorLike,
        num_steps: int,
        *,
        chunk: int | None = None,
        guidance: float = 0.0,
        independent: bool = True,
    ) -> None:
        super().__init__()
        if chunk is not None and chunk < 1:
            raise InvalidInputError(f"chunk={chunk}: at least one scene must be denoised at a time")
        self.prior = prior
        self.chunk = chunk
        self.guidance = guidance
        self.independent = independent
        if prior.conditional:
            self.in_keys = [*self.in_keys, "prompt"]
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

    @torch.no_grad()
    def read(self, prompt: Tensor) -> Text:
        """Text that the network attends to, from the token indices (B, L) of an observation.

        Without gradients: post-training leaves the text encoder as it is.
        """
        reader, size = cast(PromptedPriorLike, self.prior), self.chunk or len(prompt)
        parts = [reader.encode_tokens(part) for part in prompt.split(size)]
        return torch.cat([tokens for tokens, _ in parts]), torch.cat([mask for _, mask in parts])

    def distribution(self, x_t: Tensor, step: int, text: Text | None = None) -> ReverseStep:
        """p(x_{t-1} | x_t) of ``x_t`` (B, N, D) given ``text``; differentiable in the prior's parameters."""
        size = self.chunk or x_t.shape[0]
        prior, parts = cast(PromptedPriorLike, self.prior), []
        for rows in (slice(start, start + size) for start in range(0, x_t.shape[0], size)):
            how: dict[str, Any] = (
                {} if text is None else {"text": (text[0][rows], text[1][rows]), "guidance": self.guidance}
            )
            reverse: ReverseStep = prior.transition(x_t[rows], step, self.table, **how)
            parts.append(reverse.independent() if self.independent and isinstance(reverse, MixedStep) else reverse)
        return concatenate_steps(parts)

    @torch.no_grad()
    def draw(
        self,
        x_t: Tensor,
        step: int,
        generator: Generator | None = None,
        text: Text | None = None,
        noise: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """An action (B, N, D) and its log-probability per slot (B, N), without gradients.

        The action is made from standard normal ``noise`` (B, N, D). If ``noise`` is None, ``generator`` draws it.
        """
        reverse = self.distribution(x_t, step, text)
        if noise is None:
            noise = torch.randn(x_t.shape, generator=generator, device=x_t.device)
        action = reverse.from_noise(noise)
        return action, reverse.log_prob(action)

    def log_prob(self, x_t: Tensor, step: int, action: Tensor, text: Text | None = None) -> Tensor:
        """(B, N) log-probability per slot of ``action``; states and actions are taken as constants."""
        return self.distribution(x_t.detach(), step, text).log_prob(action.detach())

    @torch.no_grad()
    def random_entries(self, slots: int) -> int:
        """Number of random variables that a step of the chain draws for a scene; the other entries are known."""
        return self.distribution(self.prior.initial(1, slots, None), 0).entries

    @torch.no_grad()
    def stds(self, slots: int) -> Tensor:
        """(S,) smallest sigma of every step over its random entries, normalised units; 0 where none is random."""
        x = self.prior.initial(1, slots, None)
        stds = [self.distribution(x, step).std for step in range(len(self))]
        return torch.stack([std[std > 0].amin() if bool((std > 0).any()) else std.new_zeros(()) for std in stds])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write an action and its log-probability; rows may be at different steps."""
        scene, timestep = tensordict["scene"], tensordict["timestep"].squeeze(-1)
        prompt = tensordict.get("prompt", None)
        text = None if prompt is None else self.read(prompt)
        action = scene.clone()
        log_prob = torch.zeros(scene.shape[:-1], device=scene.device)
        for t in timestep.unique().tolist():
            rows = timestep == t
            if t == 0:  # a finished episode that waits for its reset
                continue
            part_text = None if text is None else (text[0][rows], text[1][rows])
            action[rows], log_prob[rows] = self.draw(scene[rows], self.step_of(t), text=part_text)
        found = {"action": action, "action_log_prob": log_prob.sum(dim=-1), "slot_log_prob": log_prob}
        return tensordict.update(found)


def gradient_weights(stds: Tensor, *, min_std: float = 1e-2) -> Tensor:
    """(S,) weight of every step in the policy gradient: 1, or 0 where the step is left out.

    A step whose sigma is below ``min_std`` is sampled with that sigma but excluded from the gradient. Its log-density
    is so steep that millimetres of noise outweigh the reward. (Raising the sigma of the *sampler* to ``min_std``
    instead would add that much noise to every finished scene.)

    Args:
        stds: (S,) sigma of every step, normalised units.
        min_std: smallest sigma of a step in the gradient.

    >>> gradient_weights(torch.tensor([0.6, 0.2, 0.005, 0.0])).tolist()
    [1.0, 1.0, 0.0, 0.0]
    """
    if min_std <= 0:
        raise InvalidInputError(f"min_std={min_std} must be positive: the last step is deterministic")
    taken = stds >= min_std
    if not bool(taken.any()):
        raise InvalidInputError(
            f"no step is left in the policy gradient: min_std={min_std}, and the sigmas of the chain are "
            f"{[round(float(s), 4) for s in stds]}"
        )
    return taken.to(stds)
