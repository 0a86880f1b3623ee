"""The scenes of a set of tables, read once: those that all rows train on, and real ones to compare with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from agents.pretraining.settings import PretrainConfig
from benchmarks.paper_tables.settings import TablesConfig
from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    from torch import Tensor

    from agents.pretraining.initial_prior import TrainingData
    from agents.priors.prior import ScenePrior
    from scene_envs.datasets import SceneDataset
    from scene_envs.scene import SceneBatch

_SAMPLE = 512
"""Scenes from which a prior is built when only its parameters are to be counted."""
_GRAMMAR_SEED = 7_000_003
"""Second part of the seed of real scenes, beside the seed of the runs; so they are no scenes that runs train on."""


@dataclass(frozen=True)
class RowData:
    """Training and held-out scenes, split as ``pretrain`` splits them.

    Attributes:
        training: None when the grammar gives the scenes.
        heldout: None when the grammar gives the scenes.
    """

    training: SceneDataset | None
    heldout: SceneDataset | None

    @classmethod
    def load(cls, settings: TablesConfig) -> RowData:
        """Read the folders.

        Raises:
            InvalidInputError: several folders, or scenes of another type.
        """
        from agents.pretraining.initial_prior import split_heldout

        if settings.data == "grammar":
            return cls(None, None)
        if "," in settings.data:
            raise InvalidInputError(
                f"data={settings.data!r}: the rows of a table share one scene type; name one folder"
            )
        whole = _read(settings.data, settings.scene)
        if settings.heldout:
            return cls(whole, _read(settings.heldout, settings.scene))
        return cls(*split_heldout(whole))

    def prepare(self, config: PretrainConfig) -> tuple[ScenePrior, TrainingData, Tensor]:
        """A fresh prior, its training scenes, and held-out scenes (K, N, D), both as the prior encodes them."""
        from agents.pretraining.initial_prior import prepare, prepare_from

        if self.training is None or self.heldout is None:
            return prepare(config)
        return prepare_from(config, self.training, self.heldout)

    def count_parameters(self, config: PretrainConfig) -> int:
        """Number of trained parameters of the prior that ``config`` asks for."""
        from agents.pretraining.initial_prior import build_prior

        if self.training is None:
            return trained_numbers(self.prepare(config)[0])
        some = self.training[:_SAMPLE]
        return trained_numbers(build_prior(config, some.tensor, some.normalizer, some.prompt_sets))


def trained_numbers(prior: ScenePrior) -> int:
    """Number of trained parameters of the network of ``prior``, without its text encoder."""
    return sum(parameter.numel() for parameter in prior.denoiser.network.parameters() if parameter.requires_grad)


@dataclass(frozen=True)
class HeldoutScenes:
    """Real scenes that no row was trained on.

    Attributes:
        reference: what samples are compared with.
        others: as many further scenes: what a perfect sampler would draw.
        prompts: one true prompt for each of ``others``, of all kinds in turn; empty where they have none.
    """

    reference: SceneBatch
    others: SceneBatch
    prompts: tuple[str, ...]

    @classmethod
    def of(cls, data: RowData, settings: TablesConfig) -> HeldoutScenes:
        """Held-out scenes, at most ``count`` of each.

        Raises:
            InvalidInputError: fewer than four held-out scenes.
        """
        if data.heldout is None:
            batch, prompt_sets = _draw(settings)
        else:
            batch, prompt_sets = data.heldout.batch(), data.heldout.prompt_sets
        half = min(settings.measured, len(batch) // 2)
        if half < 2:
            raise InvalidInputError(
                f"{len(batch)} held-out real scenes are too few to compare with; name a folder with more as heldout="
            )
        chosen = prompt_sets[half : 2 * half]
        prompts = tuple(group[number % len(group)] for number, group in enumerate(chosen)) if all(chosen) else ()
        return cls(batch[:half], batch[half : 2 * half], prompts)


def _read(folder: str, scene: str) -> SceneDataset:
    from scene_envs.datasets import SceneDataset

    dataset = SceneDataset.load(folder)
    if dataset.scene_type.name != scene:
        raise InvalidInputError(f"{folder!r} holds scenes of {dataset.scene_type.name!r}, not of scene={scene}")
    return dataset


def _draw(settings: TablesConfig) -> tuple[SceneBatch, list[tuple[str, ...]]]:
    from scene_envs.datasets import describe_all
    from scene_envs.grammars import get_grammar

    rng = np.random.default_rng([settings.seed, _GRAMMAR_SEED])
    batch = get_grammar(settings.scene).sample(rng, 2 * settings.measured)
    return batch, describe_all(batch, rng)
