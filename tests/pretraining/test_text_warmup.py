"""Text warm-up: numbers of objects that a text encoder learns before a run."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from agents.configuration.composition import changed as changed_config
from agents.pretraining.initial_prior import SceneTable, build_prior
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import warm_up_text
from agents.priors.mixed import MixedPrior
from scene_envs.datasets.prompts import describe_all
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer


def fresh(count: int = 24, **keys: object) -> tuple[MixedPrior, SceneTable]:
    """A prior without training, and ``count`` scenes with prompts."""
    scenes = get_grammar("living_room_shelf").sample(np.random.default_rng(0), count)
    prompts = describe_all(scenes, np.random.default_rng(0))
    text = {"encoder": "vocabulary", "vocabulary": {"width": 48, "depth": 1, "latents": 2}}
    small = PretrainConfig(scene="living_room_shelf", text=text, network={"hidden": 32, "depth": 2, "heads": 2})
    config = changed_config(small, keys)
    prior = build_prior(config, scenes.tensor, Normalizer.fit(scenes.tensor), prompts)
    assert isinstance(prior, MixedPrior)
    return prior, SceneTable(prior.encode(scenes), prompts)


def read_numbers(prior: MixedPrior, prompt: str) -> torch.Tensor:
    """The likeliest number of each kind of object, and of all objects."""
    conditioning = prior.denoiser.network.count_conditioning
    with torch.no_grad():
        return conditioning.count_logits(prior.encode_prompts([prompt])[0][:, : conditioning.things]).argmax(dim=-1)[0]  # type: ignore[no-any-return]


@pytest.mark.slow
def test_numbers_of_objects_are_read_from_prompts() -> None:
    prior, data = fresh(count=96)
    assert warm_up_text(prior, data, 250, 16, seed=0) is not None
    assert [int(read_numbers(prior, f"A scene with {n} objects.")[-1]) for n in (4, 6, 8)] == [4, 6, 8]
    kinds = list(dict.fromkeys(asset.display_name for asset in prior.scene_type.library))
    games = [
        int(read_numbers(prior, f"A scene with {what}.")[kinds.index("board game")])
        for what in ("a board game", "two board games")
    ]
    assert games == [1, 2]


def test_assets_of_one_name_are_one_kind_to_a_prompt() -> None:
    prior, _ = fresh()
    names = [asset.display_name for asset in prior.scene_type.library]
    assert len(set(names)) < len(names)
    assert prior.denoiser.network.count_conditioning.things == len(set(names)) + 1


def test_the_same_seed_learns_the_same_and_nothing_else_changes() -> None:
    prior, data = fresh()
    priors = [prior, copy.deepcopy(prior)]
    before = {name: value.clone() for name, value in priors[0].denoiser.state_dict().items()}
    for prior in priors:
        warm_up_text(prior, data, 3, 16, seed=5)
    states = [prior.denoiser.state_dict() for prior in priors]
    changed = {name for name in before if not torch.equal(states[0][name], before[name])}
    assert all(torch.equal(states[0][name], states[1][name]) for name in before)
    assert changed
    assert all(name.startswith(("text_encoder.", "network.count_conditioning.counts_out.")) for name in changed)


@pytest.mark.parametrize(
    "keys",
    [{"text.vocabulary.count_conditioning": False}, {"network.name": "midiffusion", "process.empty_slots": "attended"}],
)
def test_a_network_without_count_conditioning_has_nothing_to_learn(keys: dict[str, object]) -> None:
    prior, data = fresh(**keys)
    assert warm_up_text(prior, data, 3, 16, seed=0) is None
