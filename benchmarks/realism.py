"""By what a classifier tells samples of a prior from real scenes, and at which noise it arises.

    python benchmarks/realism.py errors PRIOR ... --data FOLDER [--noise 0.1 0.3 1.2] [--scenes 192]
    python benchmarks/realism.py parts PRIOR --data FOLDER --kept cafe_table,chair shelf [--scenes 2000]
    python benchmarks/realism.py chains PRIOR --data FOLDER [--noise 5 0.3 0.1] [--num-steps 50] [--scenes 192]

``errors``: root mean square of the horizontal error of denoised objects of each asset, in real scenes with noise. A
refinement is left out. ``parts``: accuracy of the classifier of ``evaluate`` on scenes of which only some assets are
kept, of samples and of real scenes. ``chains``: stacks of scenes that begin as real ones with noise and are denoised
from there: where they are as in real scenes, the noise was not too large. FOLDER is a dataset folder; ``--scenes`` of
its last scenes are read.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

import torch
from torch import Generator, Tensor

from agents.diffusion import StepTable
from agents.evaluation.classifier import classifier_accuracy
from agents.evaluation.layouts import stack_wasserstein, tallest_stacks
from agents.networks.geometry import RefinementConfig
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from scene_envs.datasets import SceneDataset
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene import SceneBatch

_BATCH = 64


def main() -> None:
    """Print the table that the command line names."""
    arguments = _arguments()
    scenes = SceneDataset.load(arguments.data).tensor[-arguments.scenes :].clone()
    shown: list[int] = []  # assets of the columns
    for name in arguments.priors:
        prior = ScenePrior.load(name)
        if not isinstance(prior, MixedPrior):
            raise InvalidInputError(f"the prior {name!r} is continuous; the tables are of mixed priors")
        real = SceneBatch(scenes, prior.scene_type)
        if arguments.table == "errors":
            if not shown:
                shown = _present(real)
                print("| prior | noise, m |", *(f" {prior.scene_type.assets[k]} |" for k in shown), sep="")
                print("|---|---|", *("---|" for _ in shown), sep="")
            for level in arguments.noise:
                errors = position_errors(prior, real, level)[shown].tolist()
                print(f"| {name} | {level:g} |", *(f" {error:.3f} |" for error in errors), sep="", flush=True)
        elif arguments.table == "parts":
            print_parts(prior, real, arguments.kept)
        else:
            print_chains(prior, real, arguments.noise, arguments.num_steps)


def _present(real: SceneBatch) -> list[int]:
    """Assets of which there is one per two scenes at least, fixed objects aside."""
    objects = real.categories[:, len(real.scene_type.fixed) :].flatten()
    counts = objects.bincount(minlength=len(real.scene_type.assets) + 1)[:-1]
    return [k for k, count in enumerate(counts.tolist()) if count >= len(real) / 2]


def _timestep(prior: MixedPrior, noise: float) -> tuple[int, Tensor]:
    """The timestep whose noise along x is nearest to ``noise`` metres, and metres per normalised unit along x and y."""
    unit = 1.0 / prior.normalizer.scale[:2]
    level = prior.process.schedule.noise_to_signal * float(unit[0])
    return int((level - noise).abs().argmin()), unit


def _noisy(prior: MixedPrior, real: SceneBatch, t: int) -> Iterator[tuple[Tensor, Tensor, Generator]]:
    """Parts of the normalised real scenes, the same with noise at ``t``, and the generator of the part."""
    for number, x in enumerate(prior.normalised(real).split(_BATCH)):
        generator = Generator().manual_seed(number)
        noise = torch.randn(x.shape, generator=generator)
        yield x, prior.add_noise(x, torch.full((len(x),), t), noise), generator


@torch.no_grad()
def position_errors(prior: MixedPrior, real: SceneBatch, noise: float) -> Tensor:
    """Root mean square (C,) of the horizontal error of the denoised objects of each asset, m; fixed objects aside."""
    t, unit = _timestep(prior, noise)
    assets, fixed = len(real.scene_type.assets), len(real.scene_type.fixed)
    total, count = torch.zeros(2, assets + 1, dtype=torch.float64)
    for (x, x_t, _), categories in zip(_noisy(prior, real, t), real.categories.split(_BATCH), strict=True):
        free = prior.unconditional(len(x))
        pose, _ = prior.denoiser(x_t, t, prior.observed_entries(x_t), free, [RefinementConfig.name])
        squares = ((pose - x[..., : pose.shape[-1]])[..., :2] * unit).square().sum(dim=-1)
        moving = categories[:, fixed:].flatten()
        total.index_add_(0, moving, squares[:, fixed:].flatten().double())
        count += moving.bincount(minlength=assets + 1)
    return (total / count).sqrt()[:-1]


def print_parts(prior: MixedPrior, real: SceneBatch, kept: Sequence[str]) -> None:
    """Accuracy on whole scenes, and on scenes of which only the assets of each entry of ``kept`` are left."""
    samples = prior.sample(len(real), seed=1)
    print("| assets that are kept | told from real scenes |\n|---|---|")
    for entry in ("", *kept):
        parts = [only(batch, entry.split(",")) if entry else batch for batch in (real, samples)]
        accuracy = classifier_accuracy(*parts, seeds=5)
        print(f"| {entry or 'all'} | {100 * accuracy.mean:.1f} ± {100 * accuracy.std:.1f} % |", flush=True)


def only(batch: SceneBatch, assets: Sequence[str]) -> SceneBatch:
    """The scenes without the free and welded objects of all other assets; fixed objects stay."""
    known = batch.scene_type.assets
    for name in assets:
        if name not in known:
            raise unknown_name("asset", name, known)
    keep = torch.tensor([name in assets for name in known] + [True])[batch.categories]
    keep[:, : len(batch.scene_type.fixed)] = True
    tensor = batch.tensor.masked_fill(~keep[..., None], 0.0)
    tensor[..., -1] = torch.where(keep, tensor[..., -1], 1.0)
    return SceneBatch(tensor, batch.scene_type)


def print_chains(prior: MixedPrior, real: SceneBatch, noise: Sequence[float], num_steps: int) -> None:
    """Tallest stacks of chains that begin at real scenes with noise, W₁ to those of the real scenes themselves."""
    table = prior.step_table(num_steps)
    print("| noise at the start, m | steps | tallest stack, mean | W₁ to real scenes |\n|---|---|---|---|")
    print(f"| 0, real scenes | | {tallest_stacks(real).double().mean():.2f} | |")
    for level in noise:
        wanted, _ = _timestep(prior, level)
        start = int((table.timesteps - wanted).abs().argmin())
        rest = StepTable(table.timesteps[start:], table.previous[start:])
        ends = [prior.run_chain(x, rest, random) for _, x, random in _noisy(prior, real, int(rest.timesteps[0]))]
        batch = prior.decode(torch.cat(ends))
        mean, distance = tallest_stacks(batch).double().mean(), stack_wasserstein(batch, real)
        print(f"| {level:g} | {len(rest)} | {mean:.2f} | {distance:.2f} |", flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=("errors", "parts", "chains"))
    parser.add_argument("priors", nargs="+", help="shipped priors, or folders of priors or runs")
    parser.add_argument("--data", required=True, help="dataset folder of their scene type")
    parser.add_argument("--scenes", type=int, default=192)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.1, 0.3, 1.2], help="standard deviations, m")
    parser.add_argument("--kept", nargs="+", default=[], help="assets, joined by commas, of each row")
    parser.add_argument("--num-steps", type=int, default=50, dest="num_steps")
    return parser.parse_args()


if __name__ == "__main__":
    main()
