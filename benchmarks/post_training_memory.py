"""Peak memory of one policy gradient against the number of denoising steps.

    python benchmarks/post_training_memory.py [--prior dimsum_table_continuous] [--batch-size 8] [--steps 10 25 50 100]

Compares the score-function gradient, accumulated step by step (`DDPOSFLoss`), with a gradient that is propagated
through the whole chain. Every step is in the gradient. Hooks count the tensors that autograd keeps for the backward
pass, so the figure is exact and the same on every machine. On a GPU the allocator's peak is printed too. The states
of the chain, which the score function needs, have a column of their own: kilobytes a scene. ``--prior paper`` is the
untrained network of the paper's recipe, of mixed scenes, for which the gradient through the chain is left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any
from weakref import finalize

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from agents.diffusion.reverse_steps import GaussianStep, gaussian_log_prob
from agents.post_training import DDPOSFLoss, DenoisingPolicy
from agents.post_training.policy import gradient_weights
from agents.pretraining import PretrainConfig
from agents.pretraining.initial_prior import build_prior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer

MEBIBYTE = 2**20


class SavedTensors:
    """Context that follows the bytes autograd keeps for the backward pass; a storage counts once."""

    def __init__(self) -> None:
        self.now = self.peak = 0
        self._alive: dict[int, int] = {}

    def __enter__(self) -> SavedTensors:
        self._hooks: Any = torch.autograd.graph.saved_tensors_hooks(self._pack, lambda holder: holder.tensor)
        self._hooks.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._hooks.__exit__(kind, error, trace)

    def ignore(self, tensors: list[Tensor]) -> None:
        """Leave these out: parameters and the states of the chain exist anyway."""
        for tensor in tensors:
            self._alive[tensor.untyped_storage().data_ptr()] = 1

    def _pack(self, tensor: Tensor) -> _Holder:
        storage = tensor.untyped_storage()
        pointer, size = storage.data_ptr(), storage.nbytes()
        holder = _Holder(tensor)
        if pointer not in self._alive:
            self.now += size
            self.peak = max(self.peak, self.now)
            self._alive[pointer] = 0
        self._alive[pointer] += 1
        finalize(holder, self._release, pointer, size)
        return holder

    def _release(self, pointer: int, size: int) -> None:
        self._alive[pointer] -= 1
        if self._alive[pointer] == 0:
            del self._alive[pointer]
            self.now -= size


class _Holder:
    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor


@dataclass(frozen=True)
class Row:
    """Peak bytes of one gradient."""

    steps: int
    score_function: int
    through_chain: int
    states: int


def score_function(prior: ScenePrior, steps: int, batch: int) -> tuple[Callable[[], None], list[Tensor]]:
    """A function that computes the gradient as in training, and the states of the chain that it reads."""
    policy = DenoisingPolicy(prior, steps)
    loss = DDPOSFLoss(policy, step_weights=gradient_weights(policy.stds(prior.config.slots), min_std=1e-6))
    x, states = prior.initial(batch, prior.config.slots, torch.Generator().manual_seed(0)), []
    for step in range(steps):
        action, _ = policy.draw(x, step)
        states.append((x, action))
        x = prior.clamp(action)
    advantage = torch.linspace(-1, 1, batch)

    def run() -> None:
        for step in range(steps - 1):
            timestep = policy.table.timesteps[step].expand(batch, 1)
            fields = {"scene": states[step][0], "timestep": timestep, "action": states[step][1]}
            loss(TensorDict({**fields, "advantage": advantage}, [batch]))["loss_objective"].backward()

    return run, [tensor for pair in states for tensor in pair]


def through_chain(prior: ScenePrior, steps: int, batch: int) -> Callable[[], None]:
    """A function for the same objective whose graph goes through all steps, as the states are not detached."""
    policy = DenoisingPolicy(prior, steps)
    advantage = torch.linspace(-1, 1, batch)

    def run() -> None:
        x, total = prior.initial(batch, prior.config.slots, torch.Generator().manual_seed(0)), torch.zeros(())
        for step in range(steps):
            reverse = policy.distribution(x, step)
            assert isinstance(reverse, GaussianStep), "the prior is continuous"
            mean, std = reverse.mean, reverse.std
            action = mean + std * torch.randn_like(mean)
            if step < steps - 1:
                total = total - (advantage * gaussian_log_prob(action.detach(), mean, std).sum(dim=1)).mean()
            x = action
        total.backward()

    return run


def measure(run: Callable[[], None], ignored: list[Tensor]) -> int:
    """Peak bytes kept for the backward pass."""
    with SavedTensors() as saved:
        saved.ignore(ignored)
        run()
    return saved.peak


def _prior(name: str) -> ScenePrior:
    if name == "paper":
        raw = get_grammar("dimsum_table").sample(np.random.default_rng(0), 64).tensor
        return build_prior(PretrainConfig(recipe="paper"), raw, Normalizer.fit(raw))
    return tiny_prior() if name == "tiny" else ScenePrior.load(name)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prior", default="dimsum_table_continuous", help="name, directory, 'tiny' or 'paper'")
    parser.add_argument("--batch-size", type=int, default=8)
    parser.add_argument("--steps", type=int, nargs="+", default=[10, 25, 50, 100])
    arguments = parser.parse_args()
    prior = _prior(arguments.prior)
    batch = arguments.batch_size
    weights = [p.detach() for p in prior.parameters()]
    rows = []
    for steps in arguments.steps:
        ours, states = score_function(prior, steps, batch)
        state_bytes = sum(t.numel() * t.element_size() for t in states)
        kept = measure(ours, weights + states)
        prior.zero_grad()
        mixed = arguments.prior == "paper"
        rows.append(Row(steps, kept, 0 if mixed else measure(through_chain(prior, steps, batch), weights), state_bytes))
        prior.zero_grad()
    table = Table(title=f"Kept for the backward pass, {batch} scenes, MiB")
    for head in ("steps", "score function", "through the chain", "ratio", "states of the chain"):
        table.add_column(head, justify="right")
    for row in rows:
        figures = (f"{n / MEBIBYTE:.1f}" for n in (row.score_function, row.through_chain, row.states))
        own, chain, kept_states = figures
        chain, ratio = (chain, f"{row.through_chain / row.score_function:.0f}x") if row.through_chain else ("", "")
        table.add_row(str(row.steps), own, chain, ratio, kept_states)
    Console().print(table)


if __name__ == "__main__":
    main()
