"""File integrity: checksums, complete writes, errors that name the damaged file, and one writer per folder."""

import errno
import json
import multiprocessing
import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from agents.priors import ScenePrior
from agents.priors.testing import tiny_prior
from agents.utils.checkpoints import load_checkpoint, save_checkpoint
from scene_envs import SceneBatch
from scene_envs.datasets.files import read_notes
from scene_envs.errors import CorruptFileError, InvalidInputError, SceneEnvsError, StorageError
from scene_envs.files import (
    LOCK,
    claimed,
    read_sealed,
    read_tensors,
    replacing,
    sealed,
    sweep,
    without_digest,
    write_text,
)


def flipped(path: Path, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def make_scenes(folder: Path) -> Path:
    return SceneBatch.empty("dimsum_table", 3).save(folder / "scenes.safetensors")


def make_checkpoint(folder: Path) -> Path:
    path = folder / "checkpoint.pt"
    save_checkpoint(path, {"weights": torch.arange(500.0), "step": 3})
    return path


READERS = {
    "scenes": (make_scenes, lambda path: SceneBatch.load(path).tensor),
    "checkpoint": (make_checkpoint, lambda path: load_checkpoint(path)["weights"]),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_flipped_bit_is_found_or_changes_nothing(kind, tmp_path):
    make, read = READERS[kind]
    path = make(tmp_path)
    whole, expected = path.read_bytes(), read(path)
    generator = torch.Generator().manual_seed(0)
    for bit in torch.randint(8 * len(whole), (150,), generator=generator).tolist():
        path.write_bytes(whole)
        flipped(path, bit)
        try:
            found = read(path)
        except CorruptFileError as error:
            assert str(path) in str(error)  # noqa: PT017
            assert "weights_only" not in str(error)  # noqa: PT017
        else:
            assert torch.equal(found, expected)


@pytest.mark.parametrize("kind", READERS)
def test_a_truncated_file_names_itself_whatever_its_length(kind, tmp_path):
    make, read = READERS[kind]
    path = make(tmp_path)
    whole, expected = path.read_bytes(), read(path)
    for length in sorted({0, 1, 7, 8, 9, 100, *range(0, len(whole), len(whole) // 40), len(whole) - 1}):
        path.write_bytes(whole[:length])
        try:
            found = read(path)
        except CorruptFileError as error:
            assert str(path) in str(error)  # noqa: PT017
        else:
            assert torch.equal(found, expected)  # only the checksum was cut off


def test_damaged_weights_of_a_prior_are_refused(tmp_path):
    prior = tiny_prior()
    prior.save(tmp_path)
    weights = tmp_path / "model.safetensors"
    flipped(weights, 8 * (weights.stat().st_size - 40))
    with pytest.raises(CorruptFileError, match="checksum"):
        ScenePrior.load(tmp_path)


def test_files_without_a_checksum_load(tmp_path):
    from safetensors.torch import save_file

    save_file({"a": torch.ones(3)}, tmp_path / "foreign.safetensors")
    assert torch.equal(read_tensors(tmp_path / "foreign.safetensors")[0]["a"], torch.ones(3))
    torch.save({"step": 1}, tmp_path / "foreign.pt")
    assert load_checkpoint(tmp_path / "foreign.pt") == {"step": 1}


def test_all_shipped_tensors_have_a_checksum():
    from agents.configuration.prior_names import SHIPPED

    for weights in SHIPPED.parents[1].rglob("*.safetensors"):
        assert b"sha256" in weights.read_bytes()[:100_000]


def test_an_edited_configuration_is_told_and_accepted_without_its_digest(tmp_path):
    path = tiny_prior().save(tmp_path) / "config.json"
    config = json.loads(path.read_text())
    path.write_text(json.dumps(config))  # other white space is no change
    ScenePrior.load(tmp_path)
    config["prior"]["noise_ceiling"] *= 2
    path.write_text(json.dumps(config))
    with pytest.raises(CorruptFileError, match=r"config\.json' was changed .*remove its key 'sha256'"):
        ScenePrior.load(tmp_path)
    del config["sha256"]
    path.write_text(json.dumps(config))
    assert ScenePrior.load(tmp_path).config.noise_ceiling == config["prior"]["noise_ceiling"]


def test_every_shipped_configuration_has_a_digest():
    from agents.configuration.prior_names import SHIPPED

    for path in SHIPPED.glob("*/config.json"):
        content = json.loads(path.read_text())
        assert len(content["sha256"]) == 64
        assert "sha256" not in without_digest(content, path)  # and it is the digest of the others


def test_a_changed_footer_of_a_shard_is_found(tmp_path):
    import pyarrow.parquet as pq

    from scene_envs.datasets.files import encode_shard, write_bytes

    path = tmp_path / "scenes-00000.parquet"
    write_bytes(path, encode_shard(np.zeros((3, 2, 16), np.float32), [("A scene.",)] * 3, {"tried": 5, "reasons": {}}))
    notes = {"tried": 5, "reasons": {}, "rows": 3}
    assert read_notes(path) == {
        **notes,
        "checksums": [zlib.crc32(bytes(3 * 2 * 16 * 4)), zlib.crc32(b"A scene.\0\0" * 3)],
    }
    table = pq.read_table(path)
    notes = {key: value.replace(b'"tried": 5', b'"tried": 6') for key, value in table.schema.metadata.items()}
    pq.write_table(table.replace_schema_metadata(notes), path)
    with pytest.raises(CorruptFileError, match="damaged footer"):
        read_notes(path)
    pq.write_table(table.slice(0, 2), path)
    with pytest.raises(CorruptFileError, match="damaged footer"):
        read_notes(path)


def test_flipped_bits_anywhere_in_a_shard_are_found(tmp_path):
    """In pages and, which parquet gives no checksum, in their headers and the footer, one bit at a time or two."""
    from scene_envs.datasets import SceneDataset, generate

    generate("dimsum_table", 4, tmp_path, workers=0, verify=False, progress=False)
    (shard,) = tmp_path.glob("*.parquet")
    assert read_notes(shard)["rows"] == 4
    whole, expected = shard.read_bytes(), SceneDataset.load(tmp_path)
    found, silent, bits = 0, 0, 8 * len(whole)
    pages, footer = range(8 * 64, bits // 2, 997), range(bits - 8 * 2400, bits, 61)
    for flips in [*([bit] for bit in (*pages, *footer)), *([bit, bits - 1 - bit // 2] for bit in footer[::7])]:
        shard.write_bytes(whole)
        for bit in flips:
            flipped(shard, bit)
        try:
            read = SceneDataset.load(tmp_path)
            silent += not torch.equal(read.tensor, expected.tensor) or read.prompt_sets != expected.prompt_sets
        except SceneEnvsError as error:
            found += 1
            assert shard.name in str(error)  # noqa: PT017
    assert silent == 0
    assert found > len(pages)


def test_a_shard_that_reads_as_other_rows_is_found(tmp_path):
    import pyarrow.parquet as pq

    from scene_envs.datasets.files import encode_shard, read_rows, write_bytes

    path = tmp_path / "scenes-00000.parquet"
    write_bytes(path, encode_shard(np.zeros((3, 2, 16), np.float32), [("A scene.",), ("One.", "Two."), ("B",)], {}))
    assert sum(len(rows.scenes) for rows in read_rows(path, 16)) == 3
    table = pq.read_table(path)
    for row, column, value in [(1, 0, [[0.0] * 15 + [1.0]] * 2), (2, 2, ["C"])]:
        rows = table.to_pydict()
        rows[table.column_names[column]][row] = value
        pq.write_table(table.from_pydict(rows, table.schema), path)
        with pytest.raises(CorruptFileError, match=r"scenes-00000.* are not those that were written; delete it"):
            list(read_rows(path, 16))


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS])
def test_a_write_that_is_refused_names_file_and_remedy_and_leaves_nothing(code, tmp_path):
    def refused():
        with replacing(tmp_path / "a.txt") as partial:
            partial.touch()
            raise OSError(code, os.strerror(code))

    with pytest.raises(StorageError, match=r"a\.txt.*(make room|another output)"):
        refused()
    assert list(tmp_path.iterdir()) == []


def test_a_second_writer_is_told_who_the_first_is(tmp_path):
    code = (
        "import sys; from scene_envs.files import claimed\n"
        f"with claimed({str(tmp_path)!r}, 'the first'): print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b"held\n"
        with pytest.raises(InvalidInputError, match=rf"written by the first, process {first.pid} on .*another output"):
            claimed(tmp_path, "the second").__enter__()
        first.kill()
        first.wait()
        assert (tmp_path / LOCK).exists()  # left by the killed process
        with claimed(tmp_path, "the second"), claimed(tmp_path, "the same process"):
            pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "damage", [lambda text: text[:-3], lambda text: text[:20], lambda text: text.replace("1", "2")]
)
def test_a_configuration_that_was_cut_or_changed_is_told(tmp_path, damage):
    path = tmp_path / "config.yaml"
    path.write_text(sealed("seed: 1\ncount: 10\n"))
    assert read_sealed(path) == "seed: 1\ncount: 10\n"
    path.write_text(damage(path.read_text()))
    with pytest.raises(CorruptFileError, match=r"config\.yaml"):
        read_sealed(path)
    path.write_text("seed: 1\n")
    assert read_sealed(path) == "seed: 1\n"


def test_what_killed_writers_left_is_swept_and_what_others_write_is_not(tmp_path):
    dead = multiprocessing.get_context("spawn").Process()
    dead.start()
    dead.join()
    (tmp_path / "prior").mkdir()
    gone = [tmp_path / f".a.{dead.pid}.partial", tmp_path / "prior" / f".b.json.{dead.pid}.0a1b.partial"]
    kept = tmp_path / f".c.{os.getppid()}.0a1b.partial"
    for path in (*gone, kept):
        path.touch()
    sweep(tmp_path)
    assert kept.exists()
    assert not any(path.exists() for path in gone)


def test_two_writers_of_one_file_never_share_a_partial_file(tmp_path):
    with replacing(tmp_path / "a") as one, replacing(tmp_path / "a") as two:
        assert one != two
        write_text(one, "1")
        write_text(two, "2")
    assert (tmp_path / "a").read_text() in ("1", "2")
