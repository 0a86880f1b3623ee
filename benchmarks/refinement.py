"""Refinement of a shipped prior: states of its own chains, the corrections of physics guidance, several epochs on both.

    python benchmarks/refinement.py restaurant_low_clutter_feasible runs/refined

Each round samples chains with the averaged weights, stores their states with the poses to which guidance moves the
denoised objects, and trains the refinement with the loss of guidance distillation on the states of all rounds. Other
weights stay as they are. A prior that has a refinement, such as ``runs/refined/prior``, is trained further.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import cast

import torch
from tensordict import TensorDict
from torch import Generator, nn

from agents.post_training.algorithms.guidance_distillation import GuidanceDistillation
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.settings import GuidanceDistillationSettings
from agents.priors.mixed import MixedPrior
from agents.utils.weight_average import WeightAverage, averaged_weights

STEPS, SCENES = 25, 24
"""Steps of a chain, and chains that are sampled at once."""
STATES = 64
"""States of an optimiser step."""


@torch.no_grad()
def gather(algorithm: GuidanceDistillation, batches: int, seed: int) -> TensorDict:
    """States of ``batches`` times 24 chains at the steps at which guidance acts, with the corrected poses."""
    prior, policy, parts = algorithm.prior, algorithm.policy, []
    algorithm.end_iteration()  # the teacher takes the present weights
    for batch in range(batches):
        generator = Generator().manual_seed(seed + batch)
        x, scenes = prior.initial(SCENES, prior.config.slots, generator), []
        for step in range(STEPS):
            scenes.append(x)
            x = prior.transition(x, step, policy.table).from_noise(torch.randn(x.shape, generator=generator))
        times = policy.table.timesteps.expand(SCENES, -1)
        chains = TensorDict({"scene": torch.stack(scenes, dim=1), "timestep": times}, [SCENES, STEPS])
        for step in algorithm.steps:
            rows = torch.full((SCENES,), step)
            parts.append(algorithm.corrected(chains, rows))
    return torch.cat(parts)


def refine(
    prior: MixedPrior, folder: Path, rounds: int, batches: int, epochs: int, rate: float, clip: float, seed: int
) -> None:
    """Train a refinement of ``prior`` and save it in ``folder``; states of the same ``clip`` there are read."""
    prior = prior.with_refinement()
    settings = GuidanceDistillationSettings(clip=clip, sampler_decay=0.0)
    algorithm = GuidanceDistillation(settings, DenoisingPolicy(prior, STEPS), torch.zeros(STEPS))
    prior.requires_grad_(False)
    weights = list(prior.denoiser.network.get_submodule("refinement").requires_grad_(True).parameters())
    optimizer = torch.optim.AdamW(weights, lr=rate, weight_decay=1e-3, betas=(0.9, 0.99))
    average = WeightAverage(prior, 0.98)
    folder.mkdir(parents=True, exist_ok=True)
    parts: list[TensorDict] = []
    for turn in range(rounds):
        path = folder / f"states-{turn}-clip-{clip:g}.pt"
        if not path.exists():
            with averaged_weights(prior, average):
                torch.save(gather(algorithm, batches, seed + 1000 * turn).to_dict(), path)
        known = torch.load(path)
        parts.append(TensorDict(known, [len(known["scene"])]))
        states = torch.cat(parts)
        started = time.perf_counter()
        for epoch in range(epochs):
            done = (turn * epochs + epoch) / (rounds * epochs)
            for group in optimizer.param_groups:
                group["lr"] = rate * (1.0 - 0.9 * done)
            order, total = torch.randperm(len(states), generator=Generator().manual_seed(turn * epochs + epoch)), 0.0
            chunks = order.split(STATES)
            for rows in chunks:
                loss = algorithm.loss(states[rows])["loss_objective"]
                loss.backward()
                nn.utils.clip_grad_norm_(weights, 1.0)
                optimizer.step()
                optimizer.zero_grad()
                average.update(prior)
                total += float(loss.detach())
            seconds = time.perf_counter() - started
            print(f"round {turn} epoch {epoch}: loss {total / len(chunks):.4f}, {seconds:.0f} s", flush=True)
        with averaged_weights(prior, average):
            prior.save(folder / "prior")


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("prior")
    parser.add_argument("output", type=Path)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--batches", type=int, default=40, help="of 24 chains, in each round")
    parser.add_argument("--epochs", type=int, default=10, help="on all states, in each round")
    parser.add_argument("--rate", type=float, default=1e-3, help="learning rate of AdamW; it falls to a tenth")
    parser.add_argument("--clip", type=float, default=8.0, help="largest move, in standard deviations of a position")
    parser.add_argument("--seed", type=int, default=100, help="of the chains; the next round adds 1000")
    keys = vars(parser.parse_args())
    prior, folder = cast(MixedPrior, MixedPrior.load(keys.pop("prior"))), keys.pop("output")
    refine(prior, folder, **keys)


if __name__ == "__main__":
    main()
