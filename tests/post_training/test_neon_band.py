"""Neon at chosen noise levels: the direction of its step, what it holds, and a second call."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Generator, Tensor

from agents.evaluation import grammar_scenes
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.datasets import SceneDataset
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer

RUN = ("--noise", "0.05", "3", "--own", "6", "--batch", "8", "--lr", "0.01", "--weights", "0.5", "2")


@pytest.fixture(scope="module")
def example() -> ModuleType:
    from tests.helpers.examples import load_example

    return load_example("neon_band")


@pytest.fixture(scope="module")
def base() -> ScenePrior:
    return tiny_prior("dimsum_table", process="mixed", text=True)


@pytest.fixture(scope="module")
def folders(base: ScenePrior, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    prior, data = tmp_path_factory.mktemp("prior"), tmp_path_factory.mktemp("data") / "scenes"
    scenes = grammar_scenes("dimsum_table", 6, seed=5)
    prompts = ["A scene."] * 6
    folder = SceneDataset(scenes.tensor, prompts, Normalizer.fit(scenes.tensor), scenes.scene_type).save(data)
    return str(base.save(prior)), str(folder)


def steps(example: ModuleType, folders: tuple[str, str], output: Path, count: int) -> dict[str, dict[str, Tensor]]:
    example.main([folders[0], "--data", folders[1], "--output", str(output), "--steps", str(count), *RUN])
    return {weight: ScenePrior.load(output / f"weight_{weight}").weights() for weight in ("0.5", "2")}


def test_priors_lie_on_a_line_from_the_base_prior_and_keep_what_is_not_trained(
    example: ModuleType, base: ScenePrior, folders: tuple[str, str], tmp_path: Path
) -> None:
    found, before = steps(example, folders, tmp_path, 3), base.weights()
    moved = [name for name in before if not torch.equal(found["2"][name], before[name])]
    assert moved
    assert not any("text_encoder" in name for name in moved)
    for name in before:
        half, double = found["0.5"][name] - before[name], found["2"][name] - before[name]
        torch.testing.assert_close(double, 4 * half, rtol=1e-4, atol=1e-5)


def test_a_second_call_continues_the_first(
    example: ModuleType, folders: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(example, "SAVED_EVERY", 2)
    whole = steps(example, folders, tmp_path / "whole", 4)["2"]
    train, calls = example.loss_of, 0

    def interrupted(*args: object, **keys: object) -> Tensor:
        nonlocal calls
        calls += 1
        if calls > 6:  # two copies, three steps
            raise KeyboardInterrupt
        return train(*args, **keys)

    monkeypatch.setattr(example, "loss_of", interrupted)
    with pytest.raises(KeyboardInterrupt):
        steps(example, folders, tmp_path / "parts", 4)
    monkeypatch.setattr(example, "loss_of", train)
    parts = steps(example, folders, tmp_path / "parts", 4)["2"]
    assert all(torch.equal(weight, whole[name]) for name, weight in parts.items())


def test_held_scenes_of_the_prior_itself_cost_nothing(example: ModuleType, base: ScenePrior) -> None:
    x0 = base.normalised(grammar_scenes("dimsum_table", 4, seed=1))
    t = torch.tensor([100, 300, 500, 700])
    noised = base.noised(x0, Generator().manual_seed(3), t)
    pose, _ = base.denoiser.output(noised.x_t, t, noised.observed, base.unconditional(4), [])
    error = ((pose - noised.target).square() * noised.weight).sum(dim=(1, 2)) / noised.weight.sum(dim=(1, 2))
    held = torch.tensor([True, False, True, False])
    found = example.loss_of(base, base, x0, t, held, 3, guided=False)
    torch.testing.assert_close(found, error[~held].mean())


def test_timesteps_are_drawn_inside_the_noise_and_a_quarter_below_it(example: ModuleType, base: ScenePrior) -> None:
    noise = base.process.schedule.noise_to_signal / float(base.normalizer.scale[0])
    t, held = example.Bands(base, 0.05, 3.0).draw(400, Generator().manual_seed(0))
    assert int(held.sum()) == 150  # a quarter below, an eighth above
    inside = (noise[t] >= 0.05) & (noise[t] <= 3.0)
    assert torch.equal(inside, ~held)
    assert int((noise[t] < 0.05).sum()) == 100
    logs = noise[t][inside].log()  # uniform between log 0.05 and log 3
    assert float(logs.mean()) == pytest.approx((torch.tensor([0.05, 3.0]).log().mean()), abs=0.25)


@pytest.mark.parametrize("noise", [(0.3, 0.1), (0.0, 1.0), (5e3, 6e3)])
def test_noise_that_the_prior_does_not_have_is_refused(
    example: ModuleType, base: ScenePrior, noise: tuple[float, float]
) -> None:
    with pytest.raises(InvalidInputError, match="holds no noise level of the prior; give the lowest and the highest"):
        example.Bands(base, *noise)


def test_other_settings_in_the_same_folder_are_refused(
    example: ModuleType, folders: tuple[str, str], tmp_path: Path
) -> None:
    steps(example, folders, tmp_path, 1)
    words = [folders[0], "--data", folders[1], "--output", str(tmp_path), "--steps", "1", *RUN, "--seed", "4"]
    with pytest.raises(InvalidInputError, match="was written with --seed=0, not 4; give that, or another --output"):
        example.main(words)
