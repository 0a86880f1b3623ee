"""DDPO-SF in one file: post-train a scene prior with a reward, against the public environment.

    python examples/ddpo_sf.py --prior dimsum_table --reward object_count --iterations 40

The prior may be continuous (poses and categories are real numbers that are denoised alike) or mixed (poses are real
numbers, the category of a slot is a discrete variable). Scenes are drawn without prompts.

Denoising diffusion policy optimisation by the score function (Black et al. 2024, Eq. 3), with the pretraining loss
on real scenes as regularisation (Pfaff et al. 2025, Sec. 4.3). One denoising chain is one episode: the state is
(x_t, t), the action is x_{t-1}, and the reward comes with the finished scene.

Details that matter, in the order in which they appear below:
 1. The environment holds no policy. We draw x_{t-1} from the prior's own p(x_{t-1} | x_t) and send it as the action.
 2. The last step is deterministic: its std is 0, it has no density, and it is not part of the policy. Known entries
    (the welded table, constant features) have std 0 at every step and are not part of it either. For a discrete
    category log p is exact: it is the log of the probability of the drawn state. The choice of the slots that a step
    unmasks does not depend on the network, so it is not part of log p.
 3. Steps with a tiny std (below `min_std`) are sampled but excluded from the gradient: their log-densities are so steep
    that their noise hides the reward.
 4. Scenes whose reward is invalid are excluded from all statistics and from the gradient. A failed reward is not 0.
 5. Advantages: leave-one-out baseline, one standard deviation over the batch, clipped.
 6. States and actions are constants. The gradient is that of log p(x_{t-1} | x_t) alone; it is *not* propagated
    through the chain, so one step's graph is freed before the next is built and memory does not grow with steps.
 7. Only `gradient_steps` random steps per batch enter the gradient; their sum is scaled to the number of all steps.
 8. log p is the *mean* over the random variables of a scene (pose features, and categories of a mixed prior). The
    regularisation coefficient has a meaning only together with this reduction: with a sum, the same balance needs a
    coefficient larger by the number of variables.
 9. Both gradient norms are logged. When one is 30 times the other, the smaller one has no effect.

Measured with the defaults below (prior `dimsum_table_continuous`), one CPU core, seven minutes: 18.0 objects at first,
25.8 after 40 iterations, held-out loss 1.05 times the base prior's.
"""

from __future__ import annotations

import argparse
import csv
import inspect
import math
import re
import time
from dataclasses import dataclass, fields
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

import scene_envs  # noqa: F401  (registers the environments)
from agents import ScenePrior
from agents.diffusion import MixedStep, ReverseStep
from scene_envs.grammars import get_grammar


@dataclass
class Args:
    prior: str = "dimsum_table_continuous"
    """shipped name or directory of the prior to start from, continuous or mixed"""
    reward: str = "object_count"
    """registered name of the reward"""
    output: str = "runs/ddpo_sf"
    """where the log and the post-trained prior go"""
    seed: int = 0
    """of everything random"""
    iterations: int = 40
    """batches of fresh scenes, and updates"""
    batch_size: int = 32
    """scenes per iteration"""
    num_steps: int = 25
    """denoising steps per scene"""
    gradient_steps: int = 8
    """steps per iteration in the policy gradient"""
    min_std: float = 0.1
    """steps with a smaller std stay out of the gradient"""
    regularization: float = 0.02
    """coefficient of the pretraining loss (mean over entries) on real scenes"""
    real_scenes: int = 2048
    """scenes drawn from the grammar for the regularisation; an eighth of them is held out"""
    learning_rate: float = 5e-5
    """of AdamW"""
    max_gradient_norm: float = 1.0
    """of the summed gradient"""
    advantage_clip: float = 5.0
    """advantages are kept within plus and minus this"""


@dataclass
class Batch:
    """What one iteration samples: S steps of B scenes."""

    states: list[Tensor]  # S of (B, N, D), x_t
    actions: list[Tensor]  # S of (B, N, D), x_{t-1}
    log_probs: list[Tensor]  # S of (B,)
    reward: Tensor  # (B,)
    valid: Tensor  # (B,) bool


def log_prob(step: ReverseStep, x: Tensor) -> Tensor:
    """Mean log-probability of scenes ``x`` (B, N, D) over what the step draws at random, (B,)."""
    if not isinstance(step, MixedStep):
        return normal_log_density(x, step.mean, step.std) / (step.std > 0).sum().clamp(min=1)
    pose = step.mean.shape[-1]  # the features of a mixed prior are the pose, then the category
    total = normal_log_density(x[..., :pose], step.mean, step.pose_std) + category_log_prob(x[..., pose:], step)
    return total / ((step.pose_std > 0).sum() + step.random.sum()).clamp(min=1)


def normal_log_density(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Sum over the entries with std > 0, (B,)."""
    random = std > 0
    safe = torch.where(random, std, 1.0)
    density = -0.5 * ((x - mean) / safe) ** 2 - safe.log() - 0.5 * math.log(2 * math.pi)
    return (density * random).sum(dim=(1, 2))


def category_log_prob(one_hot: Tensor, step: MixedStep) -> Tensor:
    """Sum over the slots whose state is drawn, (B,); rows of zeros are masked, the last state of ``step.probs``."""
    masked = 1 - one_hot.sum(dim=-1, keepdim=True)
    probability = (torch.cat([one_hot, masked], dim=-1) * step.probs).sum(dim=-1)  # (B, N), of the states drawn
    return (probability.clamp(min=1e-30).log() * step.random).sum(dim=1)


@torch.no_grad()
def sample(envs: gym.vector.VectorEnv, prior: ScenePrior, args: Args, iteration: int) -> Batch:
    """One episode in every environment under the current prior."""
    table = prior.step_table(args.num_steps)
    generator = torch.Generator().manual_seed(args.seed * 1_000_003 + iteration)
    first = args.seed + iteration * args.batch_size
    observation, info = envs.reset(seed=first)  # first, first + 1, ...; one per environment
    states, actions, log_probs = [], [], []
    for step in range(args.num_steps):
        x_t = torch.as_tensor(observation["scene"])
        reverse = prior.transition(x_t, step, table)  # p(x_{t-1} | x_t)
        action = reverse.from_noise(torch.randn(x_t.shape, generator=generator))
        observation, reward, _, _, info = envs.step(action.numpy())
        states.append(x_t.clone())
        actions.append(action)
        log_probs.append(log_prob(reverse, action))
    valid = torch.as_tensor(np.asarray(final_info(info)["reward_valid"], dtype=bool))
    return Batch(states, actions, log_probs, torch.as_tensor(np.asarray(reward)).float(), valid)


def final_info(info: dict) -> dict:
    """The info of the finished episodes: same-step autoreset moves it under ``final_info``."""
    return info.get("final_info", info)


def advantages(reward: Tensor, valid: Tensor, clip: float) -> Tensor:
    """Leave-one-out over the valid scenes, (B,); 0 for the others."""
    taken = reward[valid]
    result = torch.zeros_like(reward)
    if len(taken) < 2 or float(taken.std(unbiased=False)) < 1e-8:
        return result
    others = (taken.sum() - taken) / (len(taken) - 1)
    result[valid] = ((taken - others) / taken.std(unbiased=False)).clamp(-clip, clip)
    return result


def add_policy_gradient(prior: ScenePrior, batch: Batch, args: Args, generator: torch.Generator) -> float:
    """Accumulate the score-function gradient step by step; returns the largest |log-ratio|."""
    table = prior.step_table(args.num_steps)
    advantage = advantages(batch.reward, batch.valid, args.advantage_clip)
    stds = [smallest_std(prior, batch.states[0], step, args) for step in range(args.num_steps)]
    eligible = [step for step, std in enumerate(stds) if std >= args.min_std]
    if not eligible:
        raise SystemExit(f"no step has a std of --min-std {args.min_std}; the largest is {max(stds):.3g}")
    order = torch.randperm(len(eligible), generator=generator)[: args.gradient_steps].tolist()
    scale, largest = len(eligible) / len(order), 0.0
    for step in (eligible[i] for i in order):
        now = log_prob(prior.transition(batch.states[step], step, table), batch.actions[step])
        loss = -(advantage * now).sum() / batch.valid.sum().clamp(min=1)
        (scale * loss).backward()  # the graph of this step ends here
        largest = max(largest, float((now.detach() - batch.log_probs[step]).abs().max()))
    return largest


@torch.no_grad()
def smallest_std(prior: ScenePrior, x: Tensor, step: int, args: Args) -> float:
    """The std of a step over its random continuous entries; 0 when it is deterministic."""
    std = prior.transition(x[:1], step, prior.step_table(args.num_steps)).std
    return float(std[std > 0].min()) if std.any() else 0.0


def gradient_norm(prior: ScenePrior) -> float:
    """Norm of all accumulated gradients."""
    norms = [p.grad.norm() for p in prior.parameters() if p.grad is not None]
    return float(torch.stack(norms).norm()) if norms else 0.0


def add_regularization(prior: ScenePrior, real: Tensor, args: Args, generator: torch.Generator) -> tuple[float, float]:
    """Accumulate the pretraining gradient; returns its loss and its norm."""
    x0 = real[torch.randint(len(real), (args.batch_size,), generator=generator)]
    loss = prior.pretraining_loss(x0, generator)
    parameters = [p for p in prior.parameters() if p.requires_grad]
    gradients = torch.autograd.grad(args.regularization * loss, parameters, allow_unused=True)
    found = [(parameter, g) for parameter, g in zip(parameters, gradients, strict=True) if g is not None]
    for parameter, gradient in found:
        parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
    return float(loss.detach()), float(torch.stack([g.norm() for _, g in found]).norm())


@torch.no_grad()
def heldout_loss(prior: ScenePrior, x0: Tensor) -> float:
    """The guard: pretraining loss on held-out scenes, with the same timesteps and noise at every call."""
    return float(prior.pretraining_loss(x0, torch.Generator().manual_seed(1234)))


def main(args: Args) -> None:
    """Train, log, and save the prior."""
    prior = ScenePrior.load(args.prior)
    prior.freeze_text()
    output = Path(args.output)
    output.mkdir(parents=True, exist_ok=True)
    scene = prior.scene_type.name
    envs = gym.make_vec(
        "SceneEnvs/Denoising-v0",
        num_envs=args.batch_size,
        scene=scene,
        reward=args.reward,
        num_steps=args.num_steps,
        prior=prior,
    )
    grammar = get_grammar(scene)
    real = prior.encode(grammar.sample(np.random.default_rng(args.seed), args.real_scenes))
    real, heldout = real[: -len(real) // 8], real[-len(real) // 8 :]
    base_loss = heldout_loss(prior, heldout)
    optimizer = torch.optim.AdamW(prior.parameters(), lr=args.learning_rate, weight_decay=0.0)
    generator = torch.Generator().manual_seed(args.seed)
    started = time.perf_counter()
    with (output / "log.csv").open("w", newline="") as file:
        writer = None
        for iteration in range(args.iterations):
            batch = sample(envs, prior, args, iteration)
            if not batch.valid.any():
                raise SystemExit(
                    f"the reward {args.reward!r} scored none of {args.batch_size} scenes; nothing to learn"
                )
            optimizer.zero_grad(set_to_none=True)
            log_ratio = add_policy_gradient(prior, batch, args, generator)
            policy_norm = gradient_norm(prior)
            loss, real_norm = add_regularization(prior, real, args, generator)
            norm = torch.nn.utils.clip_grad_norm_(prior.parameters(), args.max_gradient_norm)
            if not torch.isfinite(norm):
                raise SystemExit(f"iteration {iteration} gave a gradient that is not finite; lower --learning-rate")
            optimizer.step()
            row = {
                "iteration": iteration + 1,
                "reward": float(batch.reward[batch.valid].mean()),
                "reward_std": float(batch.reward[batch.valid].std(unbiased=False)),
                "log_ratio": log_ratio,  # 0: the loss scores the very policy that sampled
                "policy_gradient_norm": policy_norm,
                "pretraining_gradient_norm": real_norm,
                "pretraining_loss": loss,
                "guard_ratio": heldout_loss(prior, heldout) / base_loss,
                "seconds": time.perf_counter() - started,
            }
            writer = writer or csv.DictWriter(file, list(row))
            if iteration == 0:
                writer.writeheader()
            writer.writerow(row)
            file.flush()
            print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
    prior.save(output / "prior")
    envs.close()


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
