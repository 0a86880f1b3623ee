"""What a pretraining run refuses, does not apply, and keeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.cli import main
from agents.pretraining.initial_prior import SceneTable, prepare
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import Pretrainer
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.datasets import generate
from scene_envs.errors import InvalidInputError, TrainingError
from scene_envs.scene import SceneBatch
from tests.helpers.small_pretraining import make_run

pytestmark = pytest.mark.usefixtures("few_residual_levels")


@pytest.mark.slow
def test_a_gradient_that_is_not_finite_is_not_applied(config: PretrainConfig, raw: torch.Tensor) -> None:
    run = make_run(config, raw)
    clip = torch.nn.utils.clip_grad_norm_

    def poisoned(parameters: Any, *arguments: Any) -> torch.Tensor:
        parameters = list(parameters)
        if run.step == 3:
            parameters[0].grad.fill_(torch.nan)
        return clip(parameters, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.nn.utils, "clip_grad_norm_", poisoned)
        with pytest.raises(TrainingError, match=r"the gradient norm became nan at step 3.*give another output"):
            run.run()
    assert all(bool(tensor.isfinite().all()) for tensor in run.network.state_dict().values())
    assert make_run(config, raw).run().card["trained_steps"] == 6


@pytest.mark.slow
def test_a_run_does_not_go_on_with_other_data(config: PretrainConfig, raw: torch.Tensor) -> None:
    make_run(replace(config, iterations=2), raw).run()
    others = raw.clone()
    others[:, 1:, 0] += 0.2
    with pytest.raises(InvalidInputError, match="was started with other scenes"):
        make_run(config, others).run()
    with pytest.raises(InvalidInputError, match="was started with other scenes"):
        make_run(config, raw[:60]).run()
    assert make_run(config, raw).run().card["trained_steps"] == 6


@pytest.mark.slow
def test_a_prior_trained_further_keeps_its_origin_and_licence(config: PretrainConfig, raw: torch.Tensor) -> None:
    older = tiny_prior()
    older.card = {
        "imported_from": "authors.ckpt", "license": "CC BY-NC", "trained_steps": 100_000, "measures": {"scenes": 2.0},
        "limits": "None.",
    }  # fmt: skip
    path = older.save(config.directory / "older")
    run = replace(config, prior=str(path), output=str(config.directory / "run"), iterations=1)
    prior = ScenePrior.load(path)
    scenes = prior.encode(SceneBatch(raw, prior.scene_type))
    card = Pretrainer(run, SceneTable(scenes[:56]), scenes[56:], prior).run().card
    assert card["license"] == "CC BY-NC"
    assert card["imported_from"] == "authors.ckpt"
    assert card["base"] == {"name": "older", "trained_steps": 100_000}
    assert card["trained_steps"] == 1
    assert not {"measures", "limits"} & card.keys()


def test_the_error_that_is_left_is_measured_on_scenes_of_every_part(
    config: PretrainConfig, raw: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(replace(config, iterations=0), raw)
    monkeypatch.setattr("agents.pretraining.trainer._RESIDUAL", 3)
    seen: list[torch.Tensor] = []
    monkeypatch.setattr(type(run.prior), "fit_residual", lambda self, x0: seen.append(x0))
    run.run()
    assert torch.equal(seen[0], run.heldout_data[[0, 3, 7]])


@pytest.mark.slow
def test_datasets_of_another_scene_type_are_named(tmp_path: Path) -> None:
    for scene in ("dimsum_table", "pantry_shelf"):
        generate(scene, 4, tmp_path / scene, workers=0, verify=False, progress=False)
    dimsum, pantry = str(tmp_path / "dimsum_table"), str(tmp_path / "pantry_shelf")
    with pytest.raises(InvalidInputError, match=r"holds scenes of 'pantry_shelf', and scene=dimsum_table"):
        prepare(PretrainConfig(data=pantry))
    with pytest.raises(InvalidInputError, match=r"heldout=.* holds scenes of 'pantry_shelf'"):
        prepare(PretrainConfig(data=dimsum, heldout=pantry))


@pytest.mark.slow
def test_a_run_of_no_steps_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate("dimsum_table", 4, tmp_path / "data", workers=0, verify=False, progress=False)
    small = ["network.hidden=16", "network.depth=1", "network.heads=1", "iterations=0"]
    assert main(["pretrain", f"data={tmp_path / 'data'}", *small, f"output={tmp_path / 'run'}"]) == 0
    assert "0 steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"process": {"noise": {"ceiling": float("inf")}}}, "ceiling=inf must be a finite number"),
        ({"loss": {"noise": {"mean": 500.0}}}, "lie outside the schedule"),
    ],
)
def test_noise_levels_outside_the_schedule_are_refused(
    config: PretrainConfig, raw: torch.Tensor, keys: dict[str, Any], told: str
) -> None:
    with pytest.raises(InvalidInputError, match=told):
        make_run(PretrainConfig(output=config.output, network=config.network, iterations=1, **keys), raw)._update()
