"""Check of a prior by its samples: reward, counts, categories, and a classifier of samples and real scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from agents.priors.prior import ScenePrior
from agents.utils.process_group import ProcessGroup
from agents.utils.seeds import derived_seed
from scene_envs.envs.scoring import RewardScorer
from scene_envs.scene import SceneBatch

_AT_ONCE = 32
"""Number of scenes sampled together."""
_CLASSIFIERS = 3
"""Number of classifiers over which the accuracy is averaged."""


@dataclass(frozen=True)
class SampleCheck:
    """Check that samples a prior from the same noise at every call, and measures the samples.

    Attributes:
        real: real scenes that are not used in training.
        scorer: scorer of the run's reward.
        count: number of samples.
        num_steps: denoising steps per sample.
        seed: seed of the noise.
        slots: slots per sample.
        prompts: one prompt per sample; None without prompts.
        guidance: weight of classifier-free guidance.
        claim_guidance: strength of claim guidance.

    >>> from agents.priors.testing import tiny_prior
    >>> scorer = RewardScorer("object_count")
    >>> prior = tiny_prior()
    >>> check = SampleCheck(prior.sample(20, num_steps=2, seed=1), scorer, 20, num_steps=2, seed=0)
    >>> sorted(check.figures(check.sample(prior)))
    ['category_kl', 'classifier_accuracy', 'count_distance', 'sample_reward', 'stack_distance']
    """

    real: SceneBatch
    scorer: RewardScorer
    count: int
    num_steps: int
    seed: int
    slots: int | None = None
    prompts: Sequence[str] | None = None
    guidance: float = 0.0
    claim_guidance: float = 0.0

    @torch.no_grad()
    def sample(self, prior: ScenePrior) -> SceneBatch:
        """``count`` scenes, from the same noise for every prior; each process of a run samples a share of them."""
        processes = ProcessGroup.current()
        starts = range(0, self.count, _AT_ONCE)
        own = {start: self._chunk(prior, start) for start in starts[processes.rank :: processes.size]}
        parts = {start: tensor for found in processes.gather(own) for start, tensor in found.items()}
        return SceneBatch(torch.cat([parts[start] for start in starts]), self.real.scene_type)

    def _chunk(self, prior: ScenePrior, start: int) -> Tensor:
        """Scenes (b, N, D) from number ``start`` on, whose noise depends on that number."""
        count = min(_AT_ONCE, self.count - start)
        prompts = None if self.prompts is None else list(self.prompts[start : start + count])
        guided = prompts is not None and any(prompts)
        batch = prior.sample(
            count,
            prompt=prompts,
            guidance=self.guidance if guided else 0.0,
            claim_guidance=self.claim_guidance if guided else 0.0,
            physics_guidance=0.0,
            num_steps=self.num_steps,
            slots=self.slots,
            seed=derived_seed(self.seed, start),
        )
        return batch.tensor.cpu()

    def figures(self, batch: SceneBatch) -> dict[str, float]:
        """Mean reward of ``batch``, and figures of its difference from the real scenes.

        The difference is measured by the distances of object counts and of tallest stacks (objects), by the KL
        divergence of categories (nats), and by the accuracy of a classifier (share of scenes). A figure that has no
        meaning, such as the categories of empty scenes, is NaN. Assets without geometry have no stacks.
        """
        from agents.evaluation.classifier import classifier_accuracy
        from agents.evaluation.metrics import category_kl, count_wasserstein
        from agents.evaluation.stacks import stack_wasserstein

        batch = batch.to("cpu")
        score = self.scorer(batch, self.prompts)
        valid = score.valid.cpu()
        empty = not int(batch.counts.sum())
        return {
            "sample_reward": float(score.value.cpu()[valid].mean()) if bool(valid.any()) else float("nan"),
            "count_distance": count_wasserstein(batch, self.real),
            **({"stack_distance": stack_wasserstein(batch, self.real)} if batch.scene_type.has_geometry else {}),
            "category_kl": float("nan") if empty else category_kl(batch, self.real),
            "classifier_accuracy": classifier_accuracy(self.real, batch, seeds=_CLASSIFIERS, seed=self.seed).mean,
        }


def beyond(figures: Mapping[str, float], base: Mapping[str, float], limits: Mapping[str, float]) -> list[str]:
    """Names of the figures that exceed the base prior's by more than their limit; figures without a limit never do.

    A limit of a figure that was not measured is ignored.

    >>> beyond({"category_kl": 0.3}, {"category_kl": 0.1}, {"category_kl": 0.1, "stack_distance": 0.5})
    ['category_kl']
    """
    measured = [name for name in limits if name in figures and name in base]
    return [name for name in measured if not figures[name] <= base[name] + limits[name]]
