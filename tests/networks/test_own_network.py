"""A network of a package outside the repository: found by its entry point, trained, saved, loaded and sampled."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pytest
import torch

from agents import PretrainConfig, ScenePrior, pretrain
from agents.networks import (
    MixedFlux,
    MixedFluxConfig,
    MixedMiDiffusionConfig,
    list_networks,
    network_config,
    registry,
)
from agents.networks.registry import register_network
from scene_envs.errors import InvalidInputError, UnknownNameError
from tests.helpers.outside_package import installed


@pytest.fixture(scope="module", autouse=True)
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The package of examples/extending on the path; forgotten afterwards."""
    with patch.dict(registry._ENTRIES), installed(tmp_path_factory.mktemp("site")):
        yield


def test_it_is_listed_without_an_import_of_its_package() -> None:
    assert list_networks("mixed") == ["flux", "midiffusion", "diffuscene", "deep_sets"]
    assert "deep_sets" not in list_networks("continuous")
    with pytest.raises(UnknownNameError, match="did you mean 'deep_sets'"):
        network_config("deep_set", "mixed", features=20, categories=8, hidden=16, depth=2, heads=2)


@pytest.mark.usefixtures("few_grammar_scenes")
def test_two_steps_train_it_and_its_files_give_it_back(tmp_path: Path) -> None:
    config = PretrainConfig(
        data="grammar", output=str(tmp_path / "run"), iterations=2, batch_size=4,
        network={"name": "deep_sets", "hidden": 16, "depth": 3}, process={"empty_slots": "attended"},
        optimizer={"rate": {"warmup": 1}}, logger={"log_every": 1, "evaluate_every": 2, "checkpoint_every": 2},
    )  # fmt: skip
    pretrain(config)
    prior = ScenePrior.load(tmp_path / "run")
    network = prior.denoiser.network
    assert type(network).__name__ == "DeepSets"
    assert (network.config.hidden, network.config.depth) == (16, 3)
    assert bool(torch.isfinite(prior.sample(2, num_steps=3, seed=0).tensor).all())
    assert float(network.out.weight.detach().abs().sum()) > 0


@pytest.mark.usefixtures("few_grammar_scenes")
def test_slots_that_it_cannot_ignore_are_refused(tmp_path: Path) -> None:
    config = PretrainConfig(data="grammar", output=str(tmp_path), iterations=1, network="deep_sets", process="mixed")
    with pytest.raises(InvalidInputError, match="empty_slots='attended'"):
        pretrain(config)


def test_a_name_that_is_taken_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="there is a mixed network 'flux' already"):
        register_network("flux", "mixed", MixedMiDiffusionConfig, lambda config: None)  # type: ignore[arg-type, return-value]
    register_network("flux", "mixed", MixedFluxConfig, MixedFlux)  # once more, as a module imported twice
