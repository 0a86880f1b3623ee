"""Checkpoints of the paper's authors: exactly their function, safely read, and what does not fit is named."""

from __future__ import annotations

import logging
import pickle
import sys
from pathlib import Path

import pytest
import torch

from agents.priors.checkpoint_import import _reorder, import_checkpoint, read_lightning
from agents.priors.prior import ScenePrior
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError, UnknownNameError
from tests.helpers.authors_flux import DIMSUM, forward, random_state, write_checkpoint


@pytest.mark.parametrize("text", [0, 10])
def test_the_network_computes_exactly_the_described_function(tmp_path: Path, text: int) -> None:
    state = random_state(text=text)
    prior = import_checkpoint(*write_checkpoint(tmp_path, state), scene=DIMSUM)
    network = prior.denoiser.network.double()
    generator = torch.Generator().manual_seed(1)
    pose = torch.randn(3, 6, 12, generator=generator, dtype=torch.float64)
    category = torch.randint(9, (3, 6), generator=generator)
    t = torch.tensor([0, 17, 999])
    words = torch.randn(3, 4, text, generator=generator, dtype=torch.float64) if text else None
    noise, logits = network(pose, category, t.double(), text=words)
    expected_noise, expected_logits = forward(state, pose, category, t, words)
    torch.testing.assert_close(noise, expected_noise, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(logits, expected_logits, atol=1e-9, rtol=1e-9)


@pytest.mark.filterwarnings("error")
@pytest.mark.slow
def test_the_result_samples_and_survives_a_round_trip(tmp_path: Path) -> None:
    prior = import_checkpoint(*write_checkpoint(tmp_path, random_state()), scene="dimsum_table")
    batch = prior.sample(2, num_steps=5, seed=0)
    assert batch.tensor.shape == (2, 34, 20)
    assert prior.card["trained_steps"] == 1234
    again = ScenePrior.load(prior.save(tmp_path / "prior"))
    assert (again.sample(2, num_steps=5, seed=0).tensor == batch.tensor).all()


def test_the_first_timestep_is_0_as_theirs(tmp_path: Path) -> None:
    state = random_state(text=0)
    prior = import_checkpoint(*write_checkpoint(tmp_path, state), scene=DIMSUM)
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    pose, logits = prior.denoiser.output(x, torch.tensor([1, 3]))
    category = torch.where(x[..., 12:].amax(-1) > 0.5, x[..., 12:].argmax(-1), 8)
    expected, expected_logits = forward(state, x[..., :12], category, torch.tensor([0, 2]), None)
    torch.testing.assert_close(pose, expected.float(), atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(logits, expected_logits.float(), atol=2e-3, rtol=2e-3)


def test_categories_follow_the_model_paths_not_their_order(tmp_path: Path) -> None:
    state = random_state(text=0)
    order = list(reversed(DIMSUM.assets))
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    straight = import_checkpoint(*write_checkpoint(tmp_path / "a", state), scene=DIMSUM)
    turned = import_checkpoint(*write_checkpoint(tmp_path / "b", state, order=order), scene=DIMSUM)
    pose, category = torch.randn(1, 7, 12), torch.arange(7)[None]
    _, logits = straight.denoiser.network(pose, category, torch.tensor([5.0]))
    _, other = turned.denoiser.network(pose, 6 - category, torch.tensor([5.0]))
    torch.testing.assert_close(other[..., :7], logits[..., :7].flip(-1), atol=1e-4, rtol=1e-4)


def test_unknown_assets_need_aliases_and_without_a_scene_type_one_is_made(tmp_path: Path) -> None:
    order = [*DIMSUM.assets[:-1], "tetsubin"]
    files = write_checkpoint(tmp_path, random_state(), order=order)
    with pytest.raises(UnknownNameError, match="aliases"):
        import_checkpoint(*files, scene=DIMSUM)
    import_checkpoint(*files, scene=DIMSUM, aliases={"tetsubin": "teapot"})
    prior = import_checkpoint(*files)
    assert prior.scene_type.assets == tuple(order)
    assert prior.scene_type.welded == ("cafe_table",)
    assert len(prior.sample(1, num_steps=2, seed=0)) == 1


def test_a_checkpoint_with_text_is_sampled_without_prompts_where_bert_is_not_at_hand(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    files = write_checkpoint(tmp_path, random_state(text=10))
    with caplog.at_level(logging.WARNING):
        prior = import_checkpoint(*files, scene=DIMSUM)
    assert "imported without prompts" in caplog.text
    assert "scene-envs[bert]" in caplog.text
    assert not prior.conditional
    assert len(prior.sample(1, num_steps=2, seed=0)) == 1
    with pytest.raises(InvalidInputError, match="trained without text"):
        prior.sample(1, prompt="A scene with 3 objects.", num_steps=1)
    with pytest.raises(MissingDependencyError, match=r"scene-envs\[bert\]"):
        import_checkpoint(*files, scene=DIMSUM, text_encoder="bert-base-uncased")
    with pytest.raises(InvalidInputError, match="trained without text; leave text_encoder='bert-base-uncased' out"):
        import_checkpoint(
            *write_checkpoint(tmp_path, random_state(text=0)), scene=DIMSUM, text_encoder="bert-base-uncased"
        )


class _Trap:
    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (Path(pickle.__name__ + ".trap"),))


def test_objects_in_the_file_are_never_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file, metadata = write_checkpoint(tmp_path, random_state(), hyper_parameters={"config": _Trap()})
    prior = import_checkpoint(file, metadata, scene=DIMSUM)
    assert len(prior.sample(1, num_steps=2, seed=0)) == 1
    assert not list(tmp_path.glob("*.trap"))


def test_nothing_is_run_in_files_older_than_the_zip_format(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path.touch, (tmp_path / "sprung",))

    (tmp_path / "bare.ckpt").write_bytes(pickle.dumps(Trap(), protocol=2))
    with pytest.raises(CorruptFileError, match="not a checkpoint of PyTorch"):
        read_lightning(tmp_path / "bare.ckpt")
    content = {"state_dict": {"x": torch.arange(3.0)}, "trap": Trap()}
    torch.save(content, tmp_path / "old.ckpt", _use_new_zipfile_serialization=False)
    assert read_lightning(tmp_path / "old.ckpt")["state_dict"]["x"].tolist() == [0.0, 1.0, 2.0]
    assert not (tmp_path / "sprung").exists()


def test_what_does_not_fit_is_named(tmp_path: Path) -> None:
    state = random_state()
    del state["scene_in.bias"], state["double_blocks.0.x_qkv_linear.weight"]
    with pytest.raises(CorruptFileError, match=r"double_blocks\.0\.scene\.qkv\.weight"):
        import_checkpoint(*write_checkpoint(tmp_path, state), scene=DIMSUM)
    with pytest.raises(CorruptFileError, match="unet_block"):
        import_checkpoint(
            *write_checkpoint(tmp_path, random_state() | {"unet_block.weight": torch.zeros(1)}), scene=DIMSUM
        )
    with pytest.raises(InvalidInputError, match="knows 5 assets"):
        import_checkpoint(*write_checkpoint(tmp_path, random_state(assets=5)), scene=DIMSUM)
    (tmp_path / "mixed.ckpt").write_bytes(b"nothing")
    with pytest.raises(CorruptFileError, match="not a checkpoint"):
        read_lightning(tmp_path / "mixed.ckpt")
    with pytest.raises(InvalidInputError, match="no checkpoint"):
        read_lightning(tmp_path / "missing.ckpt")


def test_two_model_paths_of_one_asset_are_refused() -> None:
    tensors = {"category_in.weight": torch.arange(8.0).reshape(4, 2)}
    with pytest.raises(InvalidInputError, match="each model path its own asset"):
        _reorder(dict(tensors), torch.tensor([0, 2, 2]))
    _reorder(tensors, torch.tensor([2, 0, 1]))
    assert tensors["category_in.weight"][:, 0].tolist() == [2.0, 4.0, 0.0, 6.0]
