"""Properties of priors: equivariance, clamping, inpainting, files, and errors that name wrong input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.torch import save_file

from agents.cli import main
from agents.diffusion import StepTable
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import pretrain
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.datasets import SceneDataset
from scene_envs.datasets.prompts import describe_all
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from tests.helpers.authors_flux import random_state, write_checkpoint


@pytest.fixture(scope="module")
def prior() -> ScenePrior:
    return tiny_prior()


def test_the_denoiser_is_permutation_equivariant(prior: ScenePrior) -> None:
    x = torch.randn(3, 34, 20, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([1, 400, 1000])
    order = torch.randperm(34, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(prior.denoiser(x, t)[:, order], prior.denoiser(x[:, order], t), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("num_steps", "slots"), [(50, None), (150, None), (5, 48), (1, 20)])
def test_samples_hold_the_table_and_upright_objects(prior: ScenePrior, num_steps: int, slots: int | None) -> None:
    batch = prior.sample(2, num_steps=num_steps, slots=slots, seed=1)
    assert batch.tensor.shape == (2, slots or 34, 20)
    table = batch.scene_type.assets.index("cafe_table")
    assert batch.categories[:, 0].tolist() == [table, table]
    assert bool((batch.translations[:, 0] == 0).all())
    identity = torch.eye(3).expand(2, 3, 3)
    torch.testing.assert_close(batch.rotations[:, 0], identity)
    up = batch.rotations[~batch.is_empty][:, 2, 2]
    torch.testing.assert_close(up.abs(), torch.ones_like(up))


def test_same_seed_same_scenes(prior: ScenePrior) -> None:
    first, second = (prior.sample(3, num_steps=4, seed=5).tensor for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.equal(first, prior.sample(3, num_steps=4, seed=6).tensor)


def test_the_last_step_is_deterministic_and_known_entries_have_no_noise(prior: ScenePrior) -> None:
    table = prior.step_table(10)
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    first = prior.transition(x, 0, table).std
    last = prior.transition(x, 9, table).std
    assert bool((first[0] == 0).all())
    assert bool((first[1:, :2] > 0).all())
    assert bool((last == 0).all())


def test_inpainting_keeps_the_rest_bit_identical(prior: ScenePrior) -> None:
    batch = prior.sample(3, num_steps=4, seed=2)
    mask = torch.zeros(3, 34, dtype=torch.bool)
    mask[:, 5:12] = True
    changed = prior.inpaint(batch, mask, num_steps=4, seed=9)
    assert torch.equal(changed.tensor[~mask], batch.tensor[~mask])
    assert not torch.equal(changed.tensor[mask], batch.tensor[mask])
    nothing = prior.inpaint(batch, torch.zeros_like(mask), num_steps=4)
    assert torch.equal(nothing.tensor, batch.tensor)


def test_inpainting_noise_belongs_to_the_scene(prior: ScenePrior) -> None:
    """A scene's result does not depend on which scenes share its batch."""
    batch = prior.sample(2, num_steps=4, seed=2)
    mask = torch.ones(2, 34, dtype=torch.bool)
    both = prior.inpaint(batch, mask, num_steps=4, generators=[torch.Generator().manual_seed(s) for s in (3, 4)])
    alone = prior.inpaint(batch[1], mask[1:], num_steps=4, generators=[torch.Generator().manual_seed(4)])
    torch.testing.assert_close(both.tensor[1:], alone.tensor, atol=1e-4, rtol=1e-4)


def test_a_mask_of_the_wrong_shape_is_named(prior: ScenePrior) -> None:
    batch = prior.sample(2, num_steps=2)
    with pytest.raises(InvalidInputError, match=r"\(2, 34\)"):
        prior.inpaint(batch, torch.zeros(2, 3, dtype=torch.bool))


def test_scenes_without_their_table_are_refused(prior: ScenePrior) -> None:
    batch = prior.sample(2, num_steps=2)
    shuffled = SceneBatch(batch.tensor.flip(1), batch.scene_type)
    with pytest.raises(InvalidInputError, match="cafe_table"):
        prior.encode(shuffled)


def test_the_loss_ignores_what_is_known(prior: ScenePrior) -> None:
    """Changing the network's output on the table's slot does not change the loss."""
    weight = prior.loss_weight(34)
    assert bool((weight[0] == 0).all())
    assert bool((weight[:, [5, 8, 9, 10]] == 0).all())  # tilt, constant in this scene type
    assert float(weight[1, 0]) == prior.config.translation_weight * float(weight[1, -1])


def test_save_and_load_round_trip(prior: ScenePrior, tmp_path: Path) -> None:
    prior.save(tmp_path / "mine")
    loaded = ScenePrior.load(tmp_path / "mine")
    assert torch.equal(loaded.sample(2, num_steps=3).tensor, prior.sample(2, num_steps=3).tensor)


def test_truncated_weights_are_a_clear_error(prior: ScenePrior, tmp_path: Path) -> None:
    directory = prior.save(tmp_path / "mine")
    weights = directory / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(CorruptFileError, match="truncated"):
        ScenePrior.load(directory)


def test_an_unknown_prior_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="dimsum_table"):
        ScenePrior.load("dimsum_tabel")


def test_a_directory_without_a_prior_says_so(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"config\.json"):
        ScenePrior.load(tmp_path)


NAN = float("nan")


@pytest.fixture(scope="module")
def good_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two priors, a dataset and a scene file, all in order."""
    path = tmp_path_factory.mktemp("good")
    tiny_prior(process="mixed", text=True).save(path / "prior")
    tiny_prior(process="continuous").save(path / "plain")
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 12)
    prompts = describe_all(scenes, np.random.default_rng(0))
    data = SceneDataset(scenes.tensor, prompts, Normalizer.fit(scenes.tensor), scenes.scene_type)
    data.save(path / "data")
    scenes[:2].save(path / "scenes.safetensors")
    return path


@pytest.fixture(params=["prior", "plain"])
def saved_prior(request: pytest.FixtureRequest, good_files: Path) -> ScenePrior:
    return ScenePrior.load(good_files / request.param)


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """What the command line says of wrong input."""
    assert main([str(word) for word in words]) == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err
    told = [line for line in err.splitlines() if line.startswith("scene-envs: ")]
    assert len(told) == 1
    return told[0]


def change_column(source: Path, target: Path, name: str, change: object = None) -> Path:
    """A copy of a dataset in which a column is changed, or left out."""
    target.mkdir()
    for file in source.iterdir():
        if file.suffix == ".parquet":
            table = pq.read_table(file)
            if change is None:
                table = table.drop_columns([name])
            else:
                index = table.column_names.index(name)
                values = change(table[name].to_pylist())  # type: ignore[operator]
                field = table.schema.field(index)
                table = table.set_column(index, field, pa.array(values, field.type))
            pq.write_table(table, target / file.name)
        else:
            (target / file.name).write_bytes(file.read_bytes())
    return target


def with_nan(rows: list[list[list[float]]]) -> list[list[list[float]]]:
    rows[4][3][1] = NAN
    return rows


# -- prompts ----------------------------------------------------------------------------------------------------------


def test_unknown_words_are_warned_of_and_listed(
    good_files: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    prompt = "A scene with a zeppelin and a walrus."
    ScenePrior.load(good_files / "prior").sample(1, prompt=prompt, num_steps=1)
    assert "the word(s) zeppelin, walrus;" in caplog.text
    words = ["sample", f"prior={good_files / 'prior'}", f"prompt={prompt}", "count=1", "num_steps=1", "pictures=0"]
    assert main([*words, "reward=null", "workers=0", f"output={tmp_path}"]) == 0
    assert "the word(s) zeppelin, walrus;" in capsys.readouterr().err


@pytest.mark.parametrize("prompt", ["A scene with 99 objects.", "A scene with 99 cups."])
def test_more_objects_than_slots(
    prompt: str, good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved_prior, scenes = ScenePrior.load(good_files / "prior"), SceneBatch.load(good_files / "scenes.safetensors")
    message = r"asks for 99 objects, a scene has 34 slots; give slots=99"
    with pytest.raises(InvalidInputError, match=message):
        saved_prior.sample(1, prompt=prompt, num_steps=1)
    with pytest.raises(InvalidInputError, match=message):
        saved_prior.complete(scenes, prompt=prompt, num_steps=1)
    with pytest.raises(InvalidInputError, match=message):
        saved_prior.rearrange(scenes, prompt=prompt, num_steps=1)
    for words in (("sample", "count=1"), ("complete", f"scenes={good_files / 'scenes.safetensors'}")):
        err = refused(capsys, *words, f"prior={good_files / 'prior'}", f"prompt={prompt}", f"output={tmp_path}")
        assert "give slots=99" in err


def test_a_prompt_that_a_prior_cannot_read(
    good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    err = refused(capsys, "sample", f"prior={good_files / 'plain'}", "prompt=A scene with a cup.", f"output={tmp_path}")
    assert "trained without text" in err


# -- masks and scenes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mask",
    [
        torch.zeros(2, 3, dtype=torch.bool),
        torch.zeros(34, dtype=torch.bool),
        torch.zeros(2, 34, 20, dtype=torch.bool),
        torch.zeros(1, 34, dtype=torch.bool),
        torch.zeros(2, 34),
    ],
)
def test_a_mask_of_the_wrong_shape_or_type(saved_prior: ScenePrior, good_files: Path, mask: torch.Tensor) -> None:
    scenes = SceneBatch.load(good_files / "scenes.safetensors")
    with pytest.raises(InvalidInputError, match=r"mask must be bool of shape \(2, 34\), or \(2, 34, 2\)") as error:
        saved_prior.inpaint(scenes, mask, num_steps=2)
    assert str(tuple(mask.shape)) in str(error.value)


@pytest.mark.parametrize("value", [NAN, float("inf")])
def test_scenes_that_are_not_finite(
    value: float, good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tensor = SceneBatch.load(good_files / "scenes.safetensors").tensor.clone()
    tensor[1, 7, 2] = value
    with pytest.raises(InvalidInputError, match="at scene 1, slot 7, feature 2"):
        SceneBatch(tensor, "dimsum_table")
    with pytest.raises(InvalidInputError, match="at scene 1, slot 7, feature 2"):
        SceneBatch.from_tensor(tensor, "dimsum_table")
    file = tmp_path / "bad.safetensors"
    save_file({"scenes": tensor}, file, {"scene_type": "dimsum_table"})
    for command in ("complete", "rearrange"):
        err = refused(
            capsys, command, f"scenes={file}", f"prior={good_files / 'prior'}", f"output={tmp_path / command}"
        )
        assert "at scene 1, slot 7, feature 2" in err
    assert "at scene 1, slot 7, feature 2" in refused(capsys, "project", f"scenes={file}", f"output={tmp_path / 'p'}")


def test_a_tensor_that_is_not_finite_never_becomes_scenes(saved_prior: ScenePrior) -> None:
    x = saved_prior.initial(2, 34)
    x[1, 5, 0] = NAN
    with pytest.raises(InvalidInputError, match="scene 1, slot 5"):
        saved_prior.decode(x)


# -- datasets ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_dataset_that_is_not_finite(good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = change_column(good_files / "data", tmp_path / "bad", "scenes", with_nan)
    with pytest.raises(CorruptFileError, match=r"row 4 of .*, slot 3, holds a value that is not finite"):
        pretrain(PretrainConfig(data=str(bad), output=str(tmp_path / "run"), iterations=1))
    assert not (tmp_path / "run" / "prior").exists()
    saved_prior = f"prior={good_files / 'prior'}"
    for words in (
        ("pretrain", f"data={bad}", "iterations=1"),
        ("pretrain", f"data={good_files / 'data'}", f"heldout={bad}", "iterations=1"),
        ("complete", f"scenes={bad}", saved_prior),
        ("rearrange", f"scenes={bad}", saved_prior),
        ("evaluate", f"data={bad}", saved_prior, "count=2", "num_steps=1", "workers=0"),
    ):
        assert "row 4" in refused(capsys, *words, f"output={tmp_path / 'out'}")


def test_a_dataset_without_a_column(good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = change_column(good_files / "data", tmp_path / "bad", "scenes")
    for words in (
        ("pretrain", f"data={bad}", "iterations=1"),
        ("complete", f"scenes={bad}", f"prior={good_files / 'prior'}"),
        ("evaluate", f"data={bad}", f"prior={good_files / 'prior'}", "count=2", "num_steps=1", "workers=0"),
    ):
        assert "'scenes'" in refused(capsys, *words, f"output={tmp_path / 'out'}")


def test_a_dataset_without_prompts_cannot_train_a_prior_that_reads_them(
    good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad"
    change_column(good_files / "data", tmp_path / "half", "language_annotation")
    change_column(tmp_path / "half", bad, "language_annotations")
    err = refused(capsys, "pretrain", f"data={bad}", "process=mixed", "text=vocabulary", f"output={tmp_path / 'out'}")
    assert "language_annotation" in err


# -- steps ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", [0, -3, 1001])
def test_steps_outside_the_range(
    num_steps: int, saved_prior: ScenePrior, good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = rf"num_steps={num_steps} is outside 1\.\.1000"
    scenes = SceneBatch.load(good_files / "scenes.safetensors")
    for call in (
        lambda: saved_prior.sample(1, num_steps=num_steps),
        lambda: saved_prior.complete(scenes, num_steps=num_steps),
        lambda: saved_prior.rearrange(scenes, num_steps=num_steps),
        lambda: saved_prior.step_table(num_steps),
    ):
        with pytest.raises(InvalidInputError, match=message):
            call()
    if not saved_prior.conditional:
        return
    given = [f"prior={good_files / 'prior'}", f"num_steps={num_steps}", f"output={tmp_path}"]
    for words in (
        ["sample", "count=1", "reward=null", "workers=0"],
        ["complete", f"scenes={good_files / 'scenes.safetensors'}"],
        ["rearrange", f"scenes={good_files / 'scenes.safetensors'}"],
        ["evaluate", "count=2", "workers=0", "project=false"],
    ):
        told = "must be at least 1" if num_steps < 1 else "is outside 1..1000"
        assert f"num_steps={num_steps} {told}" in refused(capsys, *words, *given)


def test_steps_of_ones_own_outside_the_range() -> None:
    for timesteps in ([1001, 500], [500, 0], [500, 500], [1, 500], []):
        with pytest.raises(InvalidInputError, match="step"):
            StepTable.from_timesteps(timesteps, 1000)


# -- files of others --------------------------------------------------------------------------------------------------


def test_foreign_checkpoints_with_missing_or_extra_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = random_state(text=0)
    less = {name: tensor for name, tensor in state.items() if name != "final_layer.linear.weight"}
    for number, (changed, named) in enumerate(
        [(less, "final.weight"), (state | {"unet.weight": torch.zeros(1)}, "unet.weight")]
    ):
        good_files = tmp_path / str(number)
        good_files.mkdir()
        files = write_checkpoint(good_files, changed)
        output = f"output={good_files / 'run'}"
        assert named in refused(capsys, "import-checkpoint", *files, "scene=dimsum_table", output)
        assert not (good_files / "run" / "prior").exists()


def test_a_prior_with_missing_or_extra_tensors(good_files: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file

    saved = ScenePrior.load(good_files / "plain").save(tmp_path)
    weights = load_file(saved / "model.safetensors")
    name, tensor = next(iter(weights.items()))
    save_file({key: value for key, value in weights.items() if key != name}, saved / "model.safetensors")
    with pytest.raises(CorruptFileError, match=rf'Missing key\(s\).*"{name}"'):
        ScenePrior.load(saved)
    save_file(weights | {"stranger": tensor.clone()}, saved / "model.safetensors")
    with pytest.raises(CorruptFileError, match=r'Unexpected key\(s\).*"stranger"'):
        ScenePrior.load(saved)
    config = json.loads((saved / "config.json").read_text())
    del config["normalizer_state"], config["sha256"]
    (saved / "config.json").write_text(json.dumps(config))
    with pytest.raises(CorruptFileError, match="normalizer_state"):
        ScenePrior.load(saved)
