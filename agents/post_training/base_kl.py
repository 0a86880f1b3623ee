"""KL divergence of a prior in training from the base prior, on scenes of its own.

Both estimates have the same target: the KL divergence of the reverse chains, in nats per random variable of a scene.
Each estimate is a series of terms with a graph each, so that memory does not grow with the number of terms.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Generator, Tensor

from agents.diffusion.divergence import step_kl
from agents.networks.text import Text
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.rollouts import Rollout
from agents.priors.prior import NoisedScenes, ScenePrior
from agents.utils.process_group import ProcessGroup, gather_rows

Parts = Iterator[Iterator[Tensor]]
"""Parts of a batch, each a series of terms (); gradients of a part are complete before they are added to others."""


def chain_kl(policy: DenoisingPolicy, base: ScenePrior, rollout: Rollout, count: int, generator: Generator) -> Parts:
    """Terms whose sum is the KL divergence of the chain that made a rollout from the base prior's (Fan et al. 2023).

    The estimate includes every random step, with as many scenes as the budget allows, because steps differ much more
    than scenes do.

    Args:
        policy: policy in training.
        base: base prior, with which the policy is compared.
        rollout: B episodes of the policy.
        count: passes over the batch that the estimate may cost, at most one per step.
        generator: draws the scenes of each step, from those of all processes.
    """
    first = DenoisingPolicy(base, len(policy), guidance=policy.guidance)
    own, processes = rollout.scenes.shape[1], ProcessGroup.current()
    batch, begin = processes.size * own, processes.rank * own
    size = policy.chunk or own
    steps = torch.nonzero(policy.table.previous > 0).flatten().tolist()  # the last step is deterministic
    count = max(1, min(batch, round(batch * count / len(steps))))
    drawn = count / processes.size  # the mean over the processes is then that over all drawn scenes
    chosen = [torch.randperm(batch, generator=generator)[:count].sort().values - begin for _ in steps]

    def part(start: int) -> Iterator[Tensor]:
        for step, rows in zip(steps, chosen, strict=True):
            rows = rows[(rows >= start) & (rows < min(start + size, own))]
            if not len(rows):
                continue
            x_t, text = rollout.scenes[step][rows], _rows(rollout.text, rows)
            observed = None if rollout.observed is None else rollout.observed[rows]
            with torch.no_grad():
                then = first.distribution(x_t, step, text, observed)
            now = policy.distribution(x_t, step, text, observed)
            entries = now.entries
            if isinstance(entries, Tensor):  # one number per scene
                yield (step_kl(now, then).sum(dim=1) / entries.clamp(min=1)).sum() / drawn
            else:
                yield step_kl(now, then).sum() / (drawn * entries)

    return (part(start) for start in range(0, own, size))


def forward_kl(
    prior: ScenePrior, base: ScenePrior, rollout: Rollout, generator: Generator, chunk: int | None = None
) -> Parts:
    """Terms whose sum estimates the same divergence from finished scenes, noised again, without their chains.

    The scenes of a batch take timesteps that are spread evenly over the chain of all timesteps. With several processes,
    each process draws timesteps and noise for the scenes of all processes, and takes those of its own scenes.

    Args:
        prior: prior in training.
        base: base prior, with which the prior is compared.
        rollout: B finished scenes of this process.
        generator: source of timesteps and noise (CPU).
        chunk: scenes per pass.
    """
    x0 = prior.encode(rollout.batch.to(prior.device))
    count, everything, total = len(x0), gather_rows(x0), prior.config.num_timesteps
    order = torch.randperm(len(everything), generator=generator)
    even = (order + torch.rand((), generator=generator)) / len(everything)
    timesteps = (2 + even * (total - 1)).long().clamp(max=total).to(x0.device)  # the last step, t = 1, is deterministic
    mask = None if rollout.observed is None else gather_rows(rollout.observed)
    observed = prior.observed_entries(everything, prior.observed_by_mask(everything, mask))
    noised = prior.noised(everything, generator, timesteps, observed)
    noised = noised.rows(ProcessGroup.current().rows(len(everything)))
    size = chunk or count
    for start in range(0, count, size):
        rows = slice(start, start + size)
        yield iter([noised_kl(prior, base, noised.rows(rows), _rows(rollout.text, rows)).sum() * ((total - 1) / count)])


def noised_kl(prior: ScenePrior, base: ScenePrior, noised: NoisedScenes, text: Text | None = None) -> Tensor:
    """(B,) KL divergences of the reverse steps t -> t - 1 from noised scenes, nats per random variable.

    For normal distributions, it is half the difference of the signal-to-noise ratios at t - 1 and t, times the squared
    difference of the denoised scenes. The pretraining loss has this weight in the evidence lower bound (Kingma et al.
    2021, Eq. 13). Known and observed entries do not contribute.
    """
    now = prior.output(noised, text)
    with torch.no_grad():
        then = base.output(noised, text)
        before = base.denoised(noised, then)
    alpha_bar = prior.process.schedule.alpha_bar
    ratio = alpha_bar / (1.0 - alpha_bar)
    rise = (ratio[noised.t.cpu() - 1] - ratio[noised.t.cpu()]).float().to(before.device)
    random = (noised.weight > 0).float()
    square = (prior.denoised(noised, now) - before).square() * random
    total, entries = 0.5 * rise * square.sum(dim=(1, 2)), random.sum(dim=(1, 2))
    of_categories = prior.category_kl(noised, now, then)
    if of_categories is not None:
        total = total + of_categories.sum(dim=1)
        entries = entries + (random.sum(dim=2) > 0).sum(dim=1)
    return total / entries.clamp(min=1.0)


def _rows(text: Text | None, rows: slice | Tensor) -> Text | None:
    return None if text is None else (text[0][rows], text[1][rows])
