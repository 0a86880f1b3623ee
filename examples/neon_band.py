"""Samples of a post-trained prior nearer to real scenes: Neon at chosen noise levels, and the same prior elsewhere.

    python examples/neon_band.py dimsum_table_feasible --data FOLDER --noise 0.05 3 --weights 1 1.5 --output runs/neon

Post-training toward a reward costs precision where noise hides the layout: stacks become shorter, chairs go to other
tables (benchmarks/research_log.md, "Neon at the noise of layouts"). This script steps away from these errors. It
writes a prior for each of ``--weights``, here ``runs/neon/weight_1`` and ``runs/neon/weight_1.5``; ``scene-envs
evaluate`` compares them. FOLDER is a dataset of the prior's scene type.

Two copies of the prior theta are trained with the pretraining loss, one on real scenes and one on samples of theta,
both with the same timesteps and noise. A prior of weight w is theta + w (theta_real - theta_own). What training
changes whatever the scenes are is in both copies, and cancels in the difference. With w = 1 this is the first round of
Neon (Alemohammad et al. 2025, arXiv 2510.03597) whose other copy is of real scenes; ``examples/neon.py`` has the
published rule.

Details that matter:
 1. Only noise between the two values of ``--noise`` (m, along x) is trained. At all other noise levels both copies are
    held at the poses of theta, and everywhere at its categories. So the last steps, which decide millimetres, and the
    numbers of objects stay as they are.
 2. The text encoder, count logits and a refinement are not trained.
 3. A step is noisy: more samples, more steps and a lower learning rate give more realism for the same loss of feasible
    objects. The weight is chosen by the feasible share and the classifier of ``evaluate``.

A second call with the same ``--output`` continues: samples are kept at once, both copies every 100 steps. One with
other settings than ``--steps`` and ``--weights`` is refused.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable
from copy import deepcopy
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from agents.networks.geometry import RefinementConfig
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from scene_envs.datasets import SceneDataset
from scene_envs.errors import InvalidInputError

FROZEN = ("text_encoder.", ".refinement.", ".count_logits.", ".count_conditioning.")
"""Parts of the names of weights that are not trained."""
POSES_HELD, CATEGORIES_HELD = 10.0, 20.0
"""Coefficients of the distances from the outputs of the prior, beside the pretraining loss."""
SAVED_EVERY = 100
"""Optimiser steps between two checkpoints."""


class Bands:
    """Timesteps of a batch: a quarter below the trained noise, an eighth above it if there is any, the rest inside."""

    def __init__(self, prior: MixedPrior, lowest: float, highest: float) -> None:
        """``lowest`` and ``highest`` are standard deviations of the noise along x, m."""
        noise = prior.process.schedule.noise_to_signal / float(prior.normalizer.scale[0])
        if not 0 < lowest < highest or not bool(((noise >= lowest) & (noise <= highest)).any()):
            raise InvalidInputError(
                f"--noise {lowest:g} {highest:g} holds no noise level of the prior; give the lowest and the highest, "
                f"m, within {noise[1]:.2g} to {noise[-1]:.2g}, such as 0.05 3"
            )
        even = torch.gradient(noise.clamp(min=1e-9).log())[0]  # equal probabilities of equal ratios of noise
        even[0] = 0.0
        self.inside = even * ((noise >= lowest) & (noise <= highest))
        self.below = even * (noise < lowest) * torch.where(noise < lowest / 30, 0.2, 1.0)
        self.above = (noise > highest).float()

    def draw(self, count: int, generator: Generator) -> tuple[Tensor, Tensor]:
        """Timesteps (count,), and (count,) bool where the poses of the prior are held."""
        below, above = count // 4, count // 8 if bool(self.above.any()) else 0
        parts = ((self.below, below), (self.above, above), (self.inside, count - below - above))
        drawn = [torch.multinomial(p, n, replacement=True, generator=generator) for p, n in parts if n]
        return torch.cat(drawn), torch.arange(count) < below + above


class Copy:
    """A copy of a prior, its optimiser, and the average of its weights."""

    def __init__(self, prior: MixedPrior, lr: float) -> None:
        self.prior, self.lr = deepcopy(prior), lr
        self.weights = {n: p for n, p in self.prior.named_parameters() if not any(part in n for part in FROZEN)}
        self.prior.requires_grad_(False)
        for weight in self.weights.values():
            weight.requires_grad_(True)
        self.optimizer = torch.optim.AdamW(self.weights.values(), lr=lr, betas=(0.9, 0.99), weight_decay=0.0)
        self.average = {name: weight.detach().clone() for name, weight in self.weights.items()}

    def update(self, loss: Tensor, step: int, steps: int) -> None:
        """One optimiser step, whose learning rate rises in 20 steps and falls to 0 in the second half."""
        rate = min(1.0, (step + 1) / 20) * min(1.0, 0.5 + 0.5 * math.cos(math.pi * max(0.0, 2 * step / steps - 1)))
        self.optimizer.param_groups[0]["lr"] = self.lr * rate
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.weights.values(), 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        decay = min(0.98, (step + 1) / (step + 10))
        for name, weight in self.weights.items():
            self.average[name].lerp_(weight.detach(), 1 - decay)

    def state(self) -> dict[str, object]:
        """Everything that a second call continues with."""
        weights = {name: weight.detach() for name, weight in self.weights.items()}
        return {"weights": weights, "average": self.average, "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, dict[str, Tensor]]) -> None:
        """Inverse of :meth:`state`."""
        for name, weight in self.weights.items():
            weight.data.copy_(state["weights"][name])
            self.average[name].copy_(state["average"][name])
        self.optimizer.load_state_dict(state["optimizer"])


def loss_of(
    copy: MixedPrior, prior: MixedPrior, x0: Tensor, t: Tensor, held: Tensor, seed: int, *, guided: bool
) -> Tensor:
    """Pretraining loss of the poses of normalised scenes (B, N, D) at timesteps (B,), but in rows ``held`` (B,) the
    distance from the poses of ``prior``, and everywhere the divergence from its categories. ``guided`` leaves out the
    refinement, as guided chains do.
    """
    noised = copy.noised(x0, Generator().manual_seed(seed), t)
    text, left_out = prior.unconditional(len(x0)), [RefinementConfig.name] if guided else []
    inputs = (noised.x_t, noised.t, noised.observed, text, left_out)
    pose, logits = copy.denoiser.output(*inputs)
    with torch.no_grad():
        pose_before, logits_before = prior.denoiser.output(*inputs)
    target = torch.where(held[:, None, None], pose_before, noised.target)
    error = ((pose - target).square() * noised.weight).sum(dim=(1, 2)) / noised.weight.sum(dim=(1, 2)).clamp(min=1)
    before, after = logits_before.log_softmax(dim=-1), logits.log_softmax(dim=-1)
    drawn = noised.drawn
    assert drawn is not None  # a mixed prior
    divergence = F.kl_div(after, before, log_target=True, reduction="none").sum(dim=-1) * drawn
    categories = (divergence.sum(dim=1) / drawn.sum(dim=1).clamp(min=1)).mean()
    return POSES_HELD * error[held].mean() + error[~held].mean() + CATEGORIES_HELD * categories


def own_samples(prior: MixedPrior, count: int, seed: int, path: Path) -> Tensor:
    """``count`` raw samples (B, N, D) of the prior, kept in ``path``."""
    if not path.is_file():
        part = path.with_suffix(".part")
        save_file({"scenes": prior.sample(count, seed=seed, physics_guidance=0).tensor.contiguous()}, part)
        part.replace(path)
    return load_file(path)["scenes"]


def require_same_settings(args: argparse.Namespace) -> None:
    """Keep the settings in ``args.output``; an InvalidInputError if it was written with others."""
    given = {k: v for k, v in vars(args).items() if k not in ("output", "steps", "weights")}
    path = args.output / "settings.json"
    kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else given
    for name, value in kept.items():
        if given[name] != value:
            raise InvalidInputError(
                f"{args.output} was written with --{name}={value}, not {given[name]}; give that, or another --output"
            )
    args.output.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(given), encoding="utf-8")


def train(
    prior: MixedPrior, scenes: Iterable[Tensor], bands: Bands, args: argparse.Namespace, path: Path
) -> list[Copy]:
    """Copies of the prior that were trained on each of ``scenes`` (M, N, D); their state is kept in ``path``."""
    copies = [(Copy(prior, args.lr), known) for known in scenes]
    generator = Generator().manual_seed(args.seed)
    first = 0
    if path.is_file():
        kept = torch.load(path)
        first = kept["step"]
        generator.set_state(kept["generator"])
        for (copy, _), state in zip(copies, kept["copies"], strict=True):
            copy.restore(state)
    for step in range(first, args.steps):
        t, held = bands.draw(args.batch, generator)
        seed = int(torch.randint(2**31, (1,), generator=generator))
        losses = []
        for copy, known in copies:
            x0 = known[torch.randint(len(known), (args.batch,), generator=generator)]
            loss = loss_of(copy.prior, prior, x0, t, held, seed, guided=step % 2 == 1)
            losses.append(float(loss.detach()))
            copy.update(loss, step, args.steps)
        if (step + 1) % SAVED_EVERY == 0 or step + 1 == args.steps:
            print(f"step {step + 1} of {args.steps}: loss {losses[0]:.4f} (real), {losses[1]:.4f} (own)", flush=True)
            part = path.with_suffix(".part")
            state = {
                "step": step + 1,
                "generator": generator.get_state(),
                "copies": [copy.state() for copy, _ in copies],
            }
            torch.save(state, part)
            part.replace(path)
    return [copy for copy, _ in copies]


def main(arguments: list[str] | None = None) -> None:
    """Sample, train both copies, and write a prior for each weight."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("prior", help="shipped prior, or folder of a prior or run")
    parser.add_argument("--data", required=True, help="dataset folder of its scene type")
    parser.add_argument("--noise", type=float, nargs=2, required=True, help="lowest and highest trained noise, m")
    parser.add_argument("--weights", type=float, nargs="+", default=[0.5, 1.0, 1.5])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--own", type=int, default=4000, help="samples of the prior")
    parser.add_argument("--steps", type=int, default=700, help="optimiser steps of each copy")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--lr", type=float, default=1e-4)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(arguments)
    prior = ScenePrior.load(args.prior)
    if not isinstance(prior, MixedPrior):
        raise InvalidInputError(f"the prior {args.prior!r} is continuous; give a mixed one")
    bands = Bands(prior, *args.noise)
    real = SceneDataset.load(args.data).batch()
    require_same_settings(args)
    own = own_samples(prior, args.own, args.seed, args.output / "own.safetensors")
    scenes = [prior.normalised(real), prior.normalised(type(real)(own, prior.scene_type))]
    of_real, of_own = train(prior, scenes, bands, args, args.output / "copies.pt")
    for weight in args.weights:
        result = deepcopy(prior)
        result.card = {k: v for k, v in prior.card.items() if k not in ("measures", "limits")}  # of other weights
        for name, parameter in result.named_parameters():
            if name in of_real.average:
                parameter.data.add_(of_real.average[name] - of_own.average[name], alpha=weight)
        result.save(args.output / f"weight_{weight:g}")
        print(args.output / f"weight_{weight:g}", flush=True)


if __name__ == "__main__":
    main()
