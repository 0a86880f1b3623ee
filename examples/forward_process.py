"""Forward-process reinforcement learning in one file: post-train a scene prior to place objects better.

    python examples/forward_process.py --prior dimsum_table --reward feasible_share --iterations 40

The prior may be continuous or mixed. The reward must say how good each object is (``per_object``), as
``feasible_share`` does. Scenes are drawn without prompts.

Negative-aware fine-tuning (NFT, Zheng et al. 2025, arXiv 2509.16117) of the poses, with credit per object, and with
the pretraining loss on real scenes as regularisation (Pfaff et al. 2025, Sec. 4.3). The reverse chain plays no part:
finished scenes are noised again, as in pretraining, and the denoiser is pulled toward the good objects and
pushed away from the bad ones. ``--loss reward_weighted`` is the plain alternative (Peters and Schaal 2007), in which
the good objects pull and nothing pushes; on ``dimsum_table`` it falls from the first iteration.

Details that matter, in the order in which they appear below:
 1. Three copies of one denoiser. The *trained* one takes the gradient. The *sampler* makes the scenes and is an average
    of the trained one's weights; it is what is saved. The *expectation* is trained on the sampler's scenes with the
    plain pretraining loss, so that it knows their mean.
 2. Credit per object: an object's advantage is its own verdict, standardised over all objects of the batch. In a noised
    scene every slot sees the others, so the loss of a slot's pose can use the slot's own advantage. Empty and welded
    slots have no advantage. Categories have no credit: the good and bad halves of their loss cancel, except for a pull
    of the logits to those of the sampler, so the number and kinds of objects stay the same.
 3. The advantage becomes an optimality r in [0, 1]; with the sampler's output `old` and the trained output `new`,

        loss = r |old + beta (new - old) - target|^2 + (1 - r) |old - beta (new - old) - target|^2

 4. `target - old` is replaced by `target - expectation`. NFT assumes that the sampler's output is the mean of the
    targets of its own samples. This does not hold: where all samples are bad, the difference pushes the sampler away
    and grows, and after about 100 iterations the run collapses. With the exact mean only the covariance of target and
    advantage is left.
 5. Weights and reductions are those of the pretraining loss: a mean over the entries of a scene that are not known.
 6. The sampler follows after every iteration, quickly at first: its decay is k / (k + 10), at most `sampler_decay`.
"""

from __future__ import annotations

import argparse
import csv
import inspect
import re
import time
from copy import deepcopy
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from agents import ScenePrior
from agents.priors.prior import NoisedScenes
from rewards import RewardOutput, evaluate_reward, make_reward
from scene_envs import SceneBatch
from scene_envs.grammars import get_grammar


@dataclass
class Args:
    prior: str = "dimsum_table"
    """shipped name or directory of the prior to start from, continuous or mixed"""
    reward: str = "feasible_share"
    """registered name of a reward with a value per object"""
    output: str = "runs/forward_process"
    """where the log and the post-trained prior go"""
    seed: int = 0
    """of everything random"""
    iterations: int = 40
    """batches of fresh scenes"""
    batch_size: int = 48
    """scenes per iteration"""
    num_steps: int = 25
    """denoising steps per scene"""
    updates: int = 2
    """optimiser steps per iteration"""
    draws: int = 2
    """timesteps and noises per scene and update"""
    loss: str = "nft"
    """nft or reward_weighted"""
    temperature: float = 1.0
    """of the weights exp(advantage / temperature) of reward_weighted"""
    beta: float = 0.5
    """strength; smaller ones step further from the sampler"""
    advantage_clip: float = 2.0
    """advantage at which an object is fully good or bad"""
    sampler_decay: float = 0.99
    """of the average that is the sampler"""
    regularization: float = 0.2
    """coefficient of the pretraining loss on real scenes"""
    real_scenes: int = 2048
    """scenes drawn from the grammar for the regularisation; an eighth of them is held out"""
    learning_rate: float = 2e-4
    """of AdamW for the trained denoiser"""
    expectation_rate: float = 3e-4
    """of AdamW for the expectation"""
    max_gradient_norm: float = 1.0
    """of each gradient"""


def advantages(batch: SceneBatch, scored: RewardOutput) -> Tensor:
    """(B, N) verdicts of the objects, standardised over the batch; 0 where there is no free object."""
    if scored.per_object is None:
        raise SystemExit("the reward has no per_object values, which credit per object needs")
    judged = batch.is_free & scored.is_valid[:, None]
    verdict = scored.per_object.double()
    taken = verdict[judged]
    if len(taken) < 2 or float(taken.std(unbiased=False)) < 1e-8:
        return torch.zeros(verdict.shape)
    others = len(taken) / (len(taken) - 1)  # makes the mean that of the *other* objects
    standardised = (verdict - taken.mean()) / taken.std(unbiased=False) * others
    return torch.where(judged, standardised, 0.0).float()


def losses(
    trained: ScenePrior,
    sampler: ScenePrior,
    expectation: ScenePrior,
    x0: Tensor,
    advantage: Tensor,
    args: Args,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """The policy's loss and the expectation's, both (B,), of scenes ``x0`` (B, N, D) noised once."""
    noised = trained.noised(x0, generator)
    output = trained.output(noised)
    new = output.continuous  # (B, N, F)
    expected = expectation.output(noised).continuous
    with torch.no_grad():
        said = sampler.output(noised)
    old = said.continuous
    credit = advantage[:, :, None].repeat(1, 1, new.shape[-1])
    credit[..., trained.pose_width :] = 0.0  # of a continuous prior: its categories are entries, too
    good = 0.5 + 0.5 * (credit / args.advantage_clip).clamp(-1.0, 1.0)
    change, error = args.beta * (new - old), noised.target - expected.detach()
    entries = good * (change - error).square() + (1 - good) * (change + error).square()
    weighted = args.loss == "reward_weighted"
    if weighted:
        entries = (credit / args.temperature).exp().clamp(max=10.0) * (new - noised.target).square()
    weight = noised.weight / noised.weight.sum(dim=(1, 2), keepdim=True).clamp(min=1.0)
    plain = ((expected - noised.target).square() * weight).sum(dim=(1, 2)) * noised.scale
    policy = (entries * weight).sum(dim=(1, 2)) * noised.scale
    if output.logits is not None:  # a mixed prior: the categories that this timestep masks
        shift = args.beta * (output.logits - said.logits)
        pull = 0.5 * (cross_entropy(said.logits + shift, noised) + cross_entropy(said.logits - shift, noised))
        pull = cross_entropy(output.logits, noised) if weighted else pull
        policy = policy + trained.config.category_weight * pull
    return policy, plain


def cross_entropy(logits: Tensor, noised: NoisedScenes) -> Tensor:
    """Mean over the slots whose category is masked, (B,)."""
    slots = F.cross_entropy(logits.flatten(0, 1), noised.category.flatten(), reduction="none")
    return (slots.view_as(noised.drawn) * noised.drawn).sum(dim=1) / noised.drawn.sum(dim=1).clamp(min=1.0)


@torch.no_grad()
def follow(sampler: ScenePrior, trained: ScenePrior, iteration: int, args: Args) -> None:
    """Move the sampler's weights toward the trained ones."""
    decay = min(args.sampler_decay, (iteration + 1) / (iteration + 11))
    for slow, fast in zip(sampler.parameters(), trained.parameters(), strict=True):
        slow.lerp_(fast, 1.0 - decay)


def optimizer_of(prior: ScenePrior, learning_rate: float) -> torch.optim.AdamW:
    """AdamW on what is trained: all but the text encoder."""
    return torch.optim.AdamW([p for p in prior.parameters() if p.requires_grad], learning_rate, weight_decay=0.0)


def apply_gradient(prior: ScenePrior, optimizer: torch.optim.AdamW, args: Args, iteration: int) -> float:
    """Clip, step and clear; returns the gradient's norm."""
    norm = torch.nn.utils.clip_grad_norm_(prior.parameters(), args.max_gradient_norm)
    if not torch.isfinite(norm):
        raise SystemExit(f"iteration {iteration} gave a gradient that is not finite; lower --learning-rate")
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    return float(norm)


@torch.no_grad()
def heldout_loss(prior: ScenePrior, x0: Tensor) -> float:
    """The guard: pretraining loss on held-out scenes, with the same timesteps and noise at every call."""
    return float(prior.pretraining_loss(x0, torch.Generator().manual_seed(1234)))


def main(args: Args) -> None:
    """Train, log, and save the sampler."""
    if args.loss not in ("nft", "reward_weighted"):
        raise SystemExit(f"--loss {args.loss}: give nft or reward_weighted")
    trained = ScenePrior.load(args.prior)
    trained.freeze_text()
    sampler, expectation = deepcopy(trained).requires_grad_(False), deepcopy(trained)
    optimizer = optimizer_of(trained, args.learning_rate)
    expectation_optimizer = optimizer_of(expectation, args.expectation_rate)
    reward = make_reward(args.reward)
    output = Path(args.output)
    output.mkdir(parents=True, exist_ok=True)
    real = trained.encode(
        get_grammar(trained.scene_type.name).sample(np.random.default_rng(args.seed), args.real_scenes)
    )
    real, heldout = real[: -len(real) // 8], real[-len(real) // 8 :]
    base_loss = heldout_loss(sampler, heldout)
    generator = torch.Generator().manual_seed(args.seed)
    started = time.perf_counter()
    with (output / "log.csv").open("w", newline="") as file:
        writer = None
        for iteration in range(args.iterations):
            seed = args.seed * 1_000_003 + iteration
            batch = sampler.sample(args.batch_size, num_steps=args.num_steps, seed=seed)
            scored = evaluate_reward(reward, batch)
            valid = scored.is_valid
            if not valid.any():
                raise SystemExit(f"the reward {args.reward!r} scored none of {args.batch_size} scenes")
            x0, advantage = trained.encode(batch), advantages(batch, scored)
            for _ in range(args.updates):
                for _ in range(args.draws):
                    policy, plain = losses(trained, sampler, expectation, x0, advantage, args, generator)
                    ((policy + plain)[valid].mean() / args.draws).backward()
                few = real[torch.randint(len(real), (args.batch_size,), generator=generator)]
                (args.regularization * trained.pretraining_loss(few, generator)).backward()
                norm = apply_gradient(trained, optimizer, args, iteration)
                apply_gradient(expectation, expectation_optimizer, args, iteration)
            follow(sampler, trained, iteration, args)
            row = {
                "iteration": iteration + 1,
                "reward": float(scored.value[valid].mean()),
                "objects": float(batch.counts.float().mean()),
                "gradient_norm": norm,
                "guard_ratio": heldout_loss(sampler, heldout) / base_loss,
                "seconds": time.perf_counter() - started,
            }
            writer = writer or csv.DictWriter(file, list(row))
            if iteration == 0:
                writer.writeheader()
            writer.writerow(row)
            file.flush()
            print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
    sampler.save(output / "prior")


def parse_args() -> Args:
    """Every field of ``Args`` as an option."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    texts = dict(re.findall(r'(\w+): \w+ = .*\n    """(.*)"""', inspect.getsource(Args)))
    for field in fields(Args):
        kind = {"str": str, "int": int, "float": float}[str(field.type)]
        text = f"{texts[field.name]} ({field.default})"
        parser.add_argument("--" + field.name.replace("_", "-"), type=kind, default=field.default, help=text)
    return Args(**vars(parser.parse_args()))


if __name__ == "__main__":
    main(parse_args())
