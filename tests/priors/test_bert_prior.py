"""Mixed priors that read prompts with BERT: trained, saved without it, loaded with and without it, imported."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from agents.configuration.composition import changed
from agents.networks.text_encoders import FOLDER_VARIABLE, load_bert
from agents.pretraining.initial_prior import build_prior
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import pretrain
from agents.priors.card import package_prior
from agents.priors.checkpoint_import import import_checkpoint
from agents.priors.files import PriorFacts
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from scene_envs.datasets import SceneDataset
from scene_envs.datasets.prompts import describe_all
from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer
from tests.helpers.authors_flux import random_state, write_checkpoint
from tests.helpers.small_bert import write_bert

pytest.importorskip("transformers")

pytestmark = pytest.mark.usefixtures("few_residual_levels")

PROMPTS = ["A scene with 12 objects.", "A scene with two cups and a table."]


@pytest.fixture(scope="module")
def bert(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bert(tmp_path_factory.mktemp("bert"), longest=128)


@pytest.fixture(autouse=True)
def no_other_bert(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)


def _data() -> SceneDataset:
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 24)
    prompts = describe_all(scenes, np.random.default_rng(0))
    return SceneDataset.from_sets(scenes.tensor, prompts, Normalizer.fit(scenes.tensor), scenes.scene_type)


@pytest.fixture(scope="module")
def prior(bert: Path) -> MixedPrior:
    data = _data()
    config = PretrainConfig(text={"encoder": str(bert)}, network={"hidden": 32, "depth": 2, "heads": 2})
    made = build_prior(config, data.tensor, data.normalizer, data.prompt_sets)
    assert isinstance(made, MixedPrior)
    generator = torch.Generator().manual_seed(0)
    for parameter in made.parameters():
        if not bool(parameter.any()):
            torch.nn.init.normal_(parameter, std=0.1, generator=generator)
    return made.eval()


def test_prompts_condition_the_network_and_bert_is_not_saved(prior: MixedPrior, tmp_path: Path) -> None:
    assert prior.conditional
    assert prior.config.network.text_width == 24
    folder = prior.save(tmp_path)
    assert PriorFacts.of(folder).text.startswith("BERT")
    assert {name for name in prior.weights() if name.startswith("text_encoder.")} == {"text_encoder.nothing"}
    again = ScenePrior.load(folder)
    first, second = (p.sample(2, prompt=PROMPTS, guidance=0.5, num_steps=3, seed=1) for p in (prior, again))
    assert torch.equal(first.tensor, second.tensor)
    other = prior.sample(2, prompt=PROMPTS[::-1], guidance=0.5, num_steps=3, seed=1)
    assert not torch.equal(first.tensor, other.tensor)


def test_without_transformers_it_is_sampled_without_prompts(
    prior: MixedPrior, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = prior.sample(2, num_steps=3, seed=1)
    prior.save(tmp_path)
    monkeypatch.setitem(sys.modules, "transformers", None)
    load_bert.cache_clear()
    again = ScenePrior.load(tmp_path)
    assert torch.equal(again.sample(2, num_steps=3, seed=1).tensor, expected.tensor)
    with pytest.raises(MissingDependencyError, match=r"scene-envs\[bert\]"):
        again.sample(1, prompt=PROMPTS[0], num_steps=1)


def test_another_bert_is_refused(prior: MixedPrior, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = prior.save(tmp_path / "prior")
    monkeypatch.setenv(FOLDER_VARIABLE, str(write_bert(tmp_path / "other", seed=5, longest=128)))
    with pytest.raises(InvalidInputError, match="is not the BERT"):
        ScenePrior.load(folder).sample(1, prompt=PROMPTS[0], num_steps=1)


@pytest.mark.slow
def test_training_reads_prompts_and_resumes_bit_for_bit(bert: Path, tmp_path: Path) -> None:
    _data().save(tmp_path / "data")
    config = PretrainConfig(
        data=str(tmp_path / "data"), text={"encoder": str(bert)}, network={"hidden": 32, "depth": 1, "heads": 2},
        iterations=4, batch_size=4, logger={"evaluate_every": 10, "checkpoint_every": 2},
        output=str(tmp_path / "whole"),
    )  # fmt: skip
    pretrain(config)
    halves = replace(config, output=str(tmp_path / "halves"))
    state = torch.load(tmp_path / "whole" / "checkpoint.pt", weights_only=False)
    assert not [name for name in state["network"] if "bert" in name or "embeddings" in name]
    flat = {"optimizer.rate.warmup": 0, "optimizer.rate.final": 1.0}
    pretrain(changed(halves, {"iterations": 2, **flat}))
    pretrain(changed(halves, flat))
    straight = changed(config, {"output": str(tmp_path / "straight"), **flat})
    pretrain(straight)
    first, second = (ScenePrior.load(tmp_path / name).weights() for name in ("halves", "straight"))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_checkpoint_of_the_authors_keeps_its_prompts(bert: Path, tmp_path: Path) -> None:
    files = write_checkpoint(tmp_path, random_state(text=24))
    prior = import_checkpoint(*files, scene="dimsum_table", text_encoder=str(bert))
    assert prior.conditional
    again = ScenePrior.load(prior.save(tmp_path / "prior"))
    first, second = (p.sample(1, prompt=PROMPTS[0], guidance=1.0, num_steps=3).tensor for p in (prior, again))
    assert torch.equal(first, second)
    assert not torch.equal(first, prior.sample(1, prompt=PROMPTS[1], guidance=1.0, num_steps=3).tensor)
    with pytest.raises(InvalidInputError, match="text tokens of width 10"):
        import_checkpoint(
            *write_checkpoint(tmp_path, random_state(text=10)), scene="dimsum_table", text_encoder=str(bert)
        )


def test_its_tokens_reach_the_network_as_bert_gives_them(bert: Path, tmp_path: Path) -> None:
    prior = import_checkpoint(
        *write_checkpoint(tmp_path, random_state(text=24)), scene="dimsum_table", text_encoder=str(bert)
    )
    loaded = load_bert(str(bert))
    read = loaded.tokenizer(PROMPTS, padding=True, return_tensors="pt")
    with torch.no_grad():
        expected = loaded.model(**read).last_hidden_state
    tokens, mask = prior.encode_prompts(PROMPTS)
    torch.testing.assert_close(tokens[mask], expected[read["attention_mask"].bool()], atol=1e-5, rtol=1e-5)


def test_the_configuration_names_the_model_and_its_digest(prior: MixedPrior, bert: Path, tmp_path: Path) -> None:
    text = json.loads((prior.save(tmp_path) / "config.json").read_text())["prior"]["text"]
    assert text["kind"] == "bert"
    assert text["model"] == str(bert)
    assert text["digest"] == load_bert(str(bert)).digest


def test_a_shipped_prior_names_no_folder_and_finds_its_bert_all_the_same(
    prior: MixedPrior, bert: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = package_prior(prior, tmp_path / "given")
    assert str(bert.parent) not in (folder / "config.json").read_text() + (folder / "README.md").read_text()
    shipped = ScenePrior.load(folder)
    with pytest.raises(InvalidInputError, match=FOLDER_VARIABLE):
        shipped.sample(1, prompt=PROMPTS[0], num_steps=1)
    monkeypatch.setenv(FOLDER_VARIABLE, str(bert))
    assert len(shipped.sample(1, prompt=PROMPTS[0], num_steps=1)) == 1
