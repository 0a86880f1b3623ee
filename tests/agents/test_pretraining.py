"""Pretraining: exact resume, learning-rate curve, and what happens when things go wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from agents.averaging import WeightAverage
from agents.new_prior import build_prior
from agents.pretrain_config import PretrainConfig
from agents.pretraining import Pretrainer, learning_rate_at
from scene_envs.errors import CorruptFileError, TrainingError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch


@pytest.fixture(scope="module")
def raw() -> torch.Tensor:
    """Tables with teapots somewhere: enough to train on."""
    generator = torch.Generator().manual_seed(0)
    scenes = SceneBatch.empty("dimsum_table", 64)
    categories = torch.where(torch.rand(64, 34, generator=generator) < 0.5, 6, 7)
    categories[:, 0] = 0
    translations = torch.rand(64, 34, 3, generator=generator) - 0.5
    translations[:, 0] = 0
    rotations = torch.eye(3).expand(64, 34, 3, 3)
    return SceneBatch.from_parts(translations, rotations, categories, scenes.scene_type).tensor


@pytest.fixture
def config(tmp_path: Path) -> PretrainConfig:
    return PretrainConfig(
        output=str(tmp_path), iterations=6, batch_size=8, hidden=16, depth=1, heads=2, warmup=2,
        log_every=1, evaluate_every=3, checkpoint_every=2,
    )  # fmt: skip


def make_run(config: PretrainConfig, raw: torch.Tensor) -> Pretrainer:
    normalizer = Normalizer.fit(raw)
    scenes = normalizer.normalize(raw)
    return Pretrainer(config, scenes[:56], scenes[56:], build_prior(config, raw, normalizer))


class Killed(Exception):
    """Stands for a killed process."""


def test_a_killed_run_resumes_bit_for_bit(config: PretrainConfig, raw: torch.Tensor, tmp_path: Path) -> None:
    whole = make_run(replace(config, output=str(tmp_path / "whole")), raw)
    whole.run()
    broken = make_run(config, raw)
    update = broken._update

    def dies_at_step_five() -> tuple[float, float]:
        if broken.step == 5:
            raise Killed
        return update()

    broken._update = dies_at_step_five  # type: ignore[method-assign]
    with pytest.raises(Killed):
        broken.run()
    resumed = make_run(config, raw)
    resumed.run()
    assert resumed.step == 6
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, resumed.network.state_dict()[name]), name
    for name, tensor in whole.average.tensors.items():
        assert torch.equal(tensor, resumed.average.tensors[name]), name


def test_nan_stops_the_run_and_keeps_the_last_checkpoint(config: PretrainConfig, raw: torch.Tensor) -> None:
    run = make_run(config, raw)
    update = run._update

    def poisoned() -> tuple[float, float]:
        if run.step == 4:
            run.train_data = torch.full_like(run.train_data, float("nan"))
        return update()

    run._update = poisoned  # type: ignore[method-assign]
    with pytest.raises(TrainingError, match="nan at step 4"):
        run.run()
    assert make_run(config, raw).run().card["trained_steps"] == 6


def test_a_truncated_checkpoint_is_named(config: PretrainConfig, raw: torch.Tensor) -> None:
    run = make_run(config, raw)
    run.run()
    run.checkpoint_path.write_bytes(run.checkpoint_path.read_bytes()[:500])
    with pytest.raises(CorruptFileError, match=r"checkpoint\.pt"):
        make_run(replace(config, iterations=8), raw).run()


def test_learning_rate_warms_up_and_ends_at_its_floor() -> None:
    config = PretrainConfig(iterations=1000, warmup=10, learning_rate=1.0, final_learning_rate=0.1)
    assert learning_rate_at(0, config) == pytest.approx(0.1)
    assert learning_rate_at(9, config) == pytest.approx(1.0)
    assert learning_rate_at(505, config) == pytest.approx(0.55)
    assert learning_rate_at(1000, config) == pytest.approx(0.1)


def test_the_weight_average_follows_its_closed_form() -> None:
    layer = torch.nn.Linear(1, 1, bias=False)
    average = WeightAverage(layer, decay=0.5)
    start = average.tensors["weight"].clone()
    with torch.no_grad():
        layer.weight.add_(1.0)
    used = [average.update(layer) for _ in range(3)]
    kept = torch.tensor(used).prod()
    torch.testing.assert_close(average.tensors["weight"], kept * start + (1 - kept) * layer.weight.detach())
