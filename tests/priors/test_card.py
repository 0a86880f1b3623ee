"""Descriptions of priors: the listing, the model card, and a folder for distribution."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agents import PretrainConfig
from agents.cli import main
from agents.configuration.composition import config_text
from agents.priors.card import OWN_LICENSE, package_prior, prior_digest, read_measures
from agents.priors.files import PriorFacts
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError

FIGURES = {
    "num_steps": 50.0,
    "scenes": 200.0,
    "feasible_fraction": 0.812,
    "floor_feasible_fraction": 0.995,
    "ready_fraction": 0.981,
    "classifier_accuracy": 0.58,
    "floor_classifier_accuracy": 0.5,
    "prompt_following": 0.93,
    "novelty": 0.954,
    "height_error_table_mm": 0.04,
    "overlap_median_mm": None,
}


CONFIG = PretrainConfig(optimizer={"lr": 2e-3, "ema": 0.99}, network={"hidden": 32}, data="/somewhere/of/mine")


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A run as pretraining leaves it."""
    folder = tmp_path / "run"
    prior = tiny_prior(process="mixed")
    prior.card = {"trained_steps": 1200, "batch_size": 96, "seconds": 600, "training_scenes": 131000}
    prior.save(folder / "prior")
    (folder / "config.yaml").write_text(config_text(CONFIG))
    (folder / "metrics.json").write_text(json.dumps(prior.card))
    (folder / "evaluation").mkdir()
    (folder / "evaluation" / "metrics.json").write_text(json.dumps(FIGURES))
    return folder


def test_a_shipped_folder_is_a_prior_with_a_card(run_folder: Path, tmp_path: Path) -> None:
    folder = package_prior(
        run_folder,
        tmp_path / "small_mixed",
        evaluation=run_folder / "evaluation",
        data="Scenes of the dimsum grammar.",
        machine="one NVIDIA H200",
        limits="Feasts of more than thirty objects.",
    )
    assert {path.name for path in folder.iterdir()} == {"config.json", "model.safetensors", "README.md"}
    prior = ScenePrior.load(folder)
    assert len(prior.sample(1, num_steps=2)) == 1
    measures = prior.card["measures"]
    assert measures == {name: value for name, value in FIGURES.items() if value is not None}
    page = (folder / "README.md").read_text()
    for expected in (
        "# Prior `small_mixed`",
        "| scene type | dimsum_table: 7 assets, 34 slots |",
        "Scenes of the dimsum grammar; 131,000 training scenes",
        "1,200 steps of 96 scenes, Muon and AdamW, peak learning rate 0.002, EMA 0.99, 10 minutes, one NVIDIA H200",
        "200 raw samples at 50 steps",
        "| feasible_fraction | 0.812 | 0.995 |",
        "Feasts of more than thirty objects.",
        OWN_LICENSE,
        "scene-envs sample prior=small_mixed count=16",
    ):
        assert expected in page
    assert page.count("prompt=") == 0
    assert not any("/somewhere" in path.read_text() for path in (folder / "README.md", folder / "config.json"))


def test_facts_are_those_of_the_weights(run_folder: Path) -> None:
    facts = PriorFacts.of(run_folder)
    weights = ScenePrior.load(run_folder).weights()
    assert facts.parameters == sum(tensor.numel() for tensor in weights.values())
    assert facts.megabytes == pytest.approx(4e-6 * facts.parameters, rel=0.1)
    assert (facts.scene_type, facts.process, facts.slots, facts.text) == ("dimsum_table", "mixed", 34, "")


def test_measured_variances_are_no_parameters(tmp_path: Path) -> None:
    prior = tiny_prior()
    before = PriorFacts.of(prior.save(tmp_path / "before")).parameters
    prior.fit_residual(prior.encode(prior.sample(2, num_steps=2)), levels=3)
    assert PriorFacts.of(prior.save(tmp_path / "after")).parameters == before


def test_the_listing_shows_measures_beside_real_scenes(run_folder: Path, tmp_path: Path) -> None:
    lines = PriorFacts.of(run_folder).lines()
    assert "reads no prompts" in lines[0]
    assert lines[-1].strip() == "not measured"
    shipped = PriorFacts.of(package_prior(run_folder, tmp_path / "x", evaluation=run_folder / "evaluation")).lines()
    text = "\n".join(shipped)
    assert "not measured" not in text
    rows = {line.rsplit("  (")[0].rsplit("  ", 1)[0].strip(): line for line in shipped[2:]}
    assert rows["free objects feasible as sampled"].endswith("81.2 %  (real scenes 99.5 %)")
    assert rows["after projection and settling"].endswith("98.1 %")
    assert rows["told from real scenes by a classifier"].endswith("58 %  (real scenes 50 %)")
    assert rows["novelty"].endswith("0.95")


def test_a_prior_that_reads_prompts_says_so(tmp_path: Path) -> None:
    folder = package_prior(tiny_prior(process="mixed", text=True), tmp_path / "words")
    assert "a vocabulary of" in PriorFacts.of(folder).lines()[0]
    assert "prompt='A scene with 12 objects.'" in (folder / "README.md").read_text()


def test_commands_package_and_show(run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluation = run_folder / "evaluation" / "metrics.json"
    output = tmp_path / "given"
    assert (
        main(
            [
                "package-prior",
                f"prior={run_folder}",
                f"output={output}",
                f"evaluation={evaluation}",
                "limits=None found.",
            ]
        )
        == 0
    )
    assert "81.2 %" in capsys.readouterr().out
    assert main(["priors", f"prior={output}"]) == 0
    assert capsys.readouterr().out.strip() == (output / "README.md").read_text().strip()
    assert main(["priors"]) == 0
    printed = capsys.readouterr().out
    assert "dimsum_table: scenes of dimsum_table, 34 slots" in printed
    assert "M parameters" in printed
    assert main(["priors", "prior=dimsum_tabel"]) == 2
    assert "did you mean 'dimsum_table'?" in capsys.readouterr().err
    assert main(["package-prior", f"prior={run_folder}"]) == 2
    assert "output=" in capsys.readouterr().err


def test_wrong_input_is_named(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="no evaluation at"):
        read_measures(tmp_path / "none.json")
    with pytest.raises(InvalidInputError, match="holds no figures of samples"):
        read_measures(run_folder / "metrics.json")
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(CorruptFileError, match="not valid JSON"):
        read_measures(tmp_path / "broken.json")
    with pytest.raises(UnknownNameError, match="float16"):
        package_prior(run_folder, tmp_path / "y", precision="half")


def test_a_packaged_prior_replaces_its_like_alone(run_folder: Path, tmp_path: Path) -> None:
    other = tiny_prior(seed=1).save(tmp_path / "other")
    for taken in (run_folder, run_folder / "prior", other):
        before = {path: path.read_bytes() for path in taken.iterdir() if path.is_file()}
        with pytest.raises(InvalidInputError, match="is no packaged prior; give a new folder"):
            package_prior(run_folder, taken)
        assert {path: path.read_bytes() for path in taken.iterdir() if path.is_file()} == before
    for source in (other, run_folder):
        folder = package_prior(source, tmp_path / "packaged")
    assert ScenePrior.load(folder).card["trained_steps"] == 1200
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_figures_of_other_weights_are_refused(tmp_path: Path) -> None:
    prior = tiny_prior()
    figures = {"scenes": 2.0, "evaluation": {"identity": {"digest": prior_digest(prior)}}}
    (tmp_path / "metrics.json").write_text(json.dumps(figures))
    package_prior(prior, tmp_path / "right", evaluation=tmp_path)
    with pytest.raises(InvalidInputError, match="figures of other weights"):
        package_prior(tiny_prior(seed=1), tmp_path / "wrong", evaluation=tmp_path)
    assert not (tmp_path / "wrong").exists()
