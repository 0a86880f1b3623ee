"""Chains as one program: calls that are captured and replayed, parts of batches, and precision of the blocks."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from typing import Any

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks import denoisers
from agents.networks.denoisers import Replays, check_precision, parts_of, products_in
from agents.networks.flux import gelu
from agents.networks.geometry import nearest_rotations
from agents.post_training import DenoisingPolicy
from agents.priors.testing import tiny_prior
from scene_envs.arrays import constant_on
from scene_envs.errors import InvalidInputError, UnknownNameError


class Recorder:
    """A capture on the CPU: the replay repeats the call and fills the outputs of the capture, as a CUDA graph does."""

    def __init__(self) -> None:
        self.captured = self.replayed = 0

    def __call__(self, call: Callable[[], Any], pool: Any) -> tuple[Callable[[], None], Any]:
        outputs = call()
        self.captured += 1

        def replay() -> None:
            self.replayed += 1
            for place, value in zip(outputs, call(), strict=True):
                place.copy_(value)

        return replay, outputs


class Doubling(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.full((1,), 2.0))

    def forward(self, x: Tensor, *, shift: Tensor | None = None) -> tuple[Tensor, Tensor]:
        result = self.factor * x
        return result if shift is None else result + shift, result


@torch.no_grad()
def test_the_third_call_of_a_layout_is_captured_and_later_ones_are_replayed() -> None:
    recorder, network = Recorder(), Doubling()
    replays = Replays(recorder, on="cpu")
    for value in range(5):
        moved, doubled = replays.run(network, torch.full((2,), float(value)), shift=torch.ones(2))
        assert moved.tolist() == [2.0 * value + 1.0] * 2
        assert doubled.tolist() == [2.0 * value] * 2
    assert (recorder.captured, recorder.replayed) == (1, 4)  # one replay is compared with the call
    earlier = replays.run(network, torch.full((2,), 7.0), shift=torch.ones(2))[1]
    network.factor.mul_(2.0)  # weights are read where they lie
    assert replays.run(network, torch.full((2,), 7.0), shift=torch.ones(2))[1].tolist() == [28.0, 28.0]
    assert earlier.tolist() == [14.0, 14.0]  # a later replay does not write into results of earlier ones
    for _ in range(3):
        replays.run(network, torch.zeros(3), shift=None)
    assert recorder.captured == 2
    network.factor = nn.Parameter(torch.ones(1))  # other memory
    assert replays.run(network, torch.full((2,), 7.0), shift=torch.ones(2))[1].tolist() == [7.0, 7.0]
    assert recorder.captured == 2
    assert copy.deepcopy(replays)._known == {}


def test_calls_with_gradients_and_on_other_devices_are_plain() -> None:
    recorder = Recorder()
    for _ in range(4):
        assert Replays(recorder, on="cpu").run(Doubling(), torch.ones(2))[0].requires_grad
        with torch.no_grad():
            Replays(recorder).run(Doubling(), torch.ones(2))
    assert recorder.captured == 0


@torch.no_grad()
def test_a_network_that_cannot_be_captured_says_so_once_and_runs(caplog: pytest.LogCaptureFixture) -> None:
    def refuse(call: Callable[[], Any], pool: Any) -> Any:
        raise RuntimeError("operation not permitted when stream is capturing")

    replays, network = Replays(refuse, on="cpu"), Doubling()
    with caplog.at_level(logging.WARNING):
        for size in (2, 3):
            for _ in range(5):
                assert replays.run(network, torch.ones(size))[0].tolist() == [2.0] * size
    (record,) = caplog.records
    assert "Doubling cannot be captured as a CUDA graph" in record.message
    assert "not permitted" in record.message


@torch.no_grad()
def test_a_graph_that_gives_other_values_is_not_used(caplog: pytest.LogCaptureFixture) -> None:
    def wrong(call: Callable[[], Any], pool: Any) -> Any:
        return lambda: None, [2.0 * value for value in call()]

    replays, network = Replays(wrong, on="cpu"), Doubling()
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            assert replays.run(network, torch.ones(2))[0].tolist() == [2.0] * 2
    assert "the graph gives other values than the network" in caplog.text


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_a_replayed_chain_gives_the_same_scenes(process: str) -> None:
    prior, recorder = tiny_prior("dimsum_table", process=process), Recorder()
    expected = prior.sample(3, num_steps=8, seed=2)

    def capture(call: Callable[[], Any], pool: Any) -> Any:
        if process == "mixed":
            return recorder(call, pool)
        replay, outputs = recorder(lambda: (call(),), pool)
        return replay, outputs[0]

    prior.denoiser.replays = Replays(capture, on="cpu")
    assert torch.equal(prior.sample(3, num_steps=8, seed=2).tensor, expected.tensor)
    assert recorder.captured == 1
    assert recorder.replayed == 7


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_parts_of_a_batch_give_what_the_batch_gives(process: str, monkeypatch: pytest.MonkeyPatch) -> None:
    prior = tiny_prior("dimsum_table", process=process)
    expected = prior.sample(5, num_steps=4, seed=1).tensor
    monkeypatch.setattr(denoisers, "_PAIRS", 2 * 34**2)
    torch.testing.assert_close(prior.sample(5, num_steps=4, seed=1).tensor, expected, atol=1e-5, rtol=1e-5)
    with torch.no_grad():
        assert parts_of(5, 34) == [slice(0, 1), slice(1, 3), slice(3, 5)]
        assert parts_of(0, 34) == [slice(0, 0)]
    assert parts_of(5, 34) == [slice(0, 5)]  # gradients: one part


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_one_timestep_of_all_scenes_is_that_timestep_of_each(process: str) -> None:
    prior = tiny_prior("dimsum_table", process=process)
    x = prior.initial(3, 34, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for t in (1, 400, 1000):
            alone, each = (prior.denoiser(x, at) for at in (t, torch.full((3,), t)))
            for one, other in zip(alone, each, strict=True):
                torch.testing.assert_close(one, other)


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_bfloat16_is_in_the_blocks_of_noisy_steps_alone(process: str) -> None:
    prior = tiny_prior("dimsum_table", process=process)
    network, seen = prior.denoiser.network, []
    network.register_forward_pre_hook(lambda *_: seen.append(network.body_precision))
    exact = prior.sample(2, num_steps=20, seed=0).tensor
    assert set(seen) == {"float32"}
    seen.clear()
    rough = prior.with_precision("bfloat16").sample(2, num_steps=20, seed=0).tensor
    steps = prior.step_table(20).timesteps
    noisy = [float(prior.process.sigma[t] / prior.process.alpha[t]) > 0.1 for t in steps]
    assert seen == ["bfloat16" if above else "float32" for above in noisy]
    assert 0 < sum(noisy) < 20
    assert torch.isfinite(rough).all()
    assert rough.dtype == torch.float32
    assert torch.equal(prior.with_precision("float32").sample(2, num_steps=20, seed=0).tensor, exact)
    seen.clear()
    prior.with_precision("bfloat16").pretraining_loss(prior.encode(prior.sample(2, num_steps=2)))
    assert seen[-1] == "float32"  # training is not changed


def test_a_precision_that_the_device_lacks_is_refused() -> None:
    prior = tiny_prior("dimsum_table")
    with pytest.raises(InvalidInputError, match=r"precision='tf32'.*'cpu'.*precision=float32"):
        prior.with_precision("tf32")
    with pytest.raises(UnknownNameError, match="bfloat16"):
        prior.with_precision("float16")
    prior.denoiser.network = nn.Identity()
    with pytest.raises(InvalidInputError, match="Identity has no body_precision"):
        prior.with_precision("bfloat16")
    check_precision("bfloat16", torch.device("cpu"))


def test_tf32_is_allowed_for_the_context_alone() -> None:
    before = torch.get_float32_matmul_precision()
    with products_in("tf32", torch.zeros(1)):
        assert torch.get_float32_matmul_precision() == "high"
    assert torch.get_float32_matmul_precision() == before
    with torch.autocast("cpu", torch.bfloat16), products_in("float32", torch.zeros(1)):
        assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == torch.bfloat16  # training in half precision goes on


def test_gelu_and_its_gradient_are_those_of_torch() -> None:
    x = torch.linspace(-12, 12, 97, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(gelu(x), F.gelu(x, approximate="tanh"))
    assert torch.autograd.gradcheck(gelu, x)
    with torch.no_grad():
        assert torch.equal(gelu(x), gelu(x.requires_grad_()).detach())


def test_nearest_rotations_are_those_of_an_svd() -> None:
    generator = torch.Generator().manual_seed(0)
    turns = torch.from_numpy(Rotation.random(60, random_state=0).as_matrix()).view(3, 20, 3, 3)
    for noise in (1e-3, 0.1, 1.0, 20.0):
        noisy = turns + noise * torch.randn(turns.shape, generator=generator, dtype=torch.float64)
        u, _, vt = torch.linalg.svd(noisy)
        u[..., -1] *= torch.linalg.det(u @ vt)[..., None]
        torch.testing.assert_close(nearest_rotations(noisy), u @ vt, atol=1e-9, rtol=0)
    nothing = torch.full((1, 2, 3, 3), torch.nan)
    torch.testing.assert_close(nearest_rotations(nothing), torch.eye(3).expand(1, 2, 3, 3))


class Asking(nn.Module):
    """Doubles its input, and keeps whether it was called in inference mode."""

    modes: list[bool]

    def forward(self, x: Tensor) -> Tensor:
        self.modes.append(torch.is_inference_mode_enabled())
        return 2.0 * x


def test_calls_without_gradients_are_in_inference_mode_and_their_outputs_serve_where_gradients_are_recorded() -> None:
    network, replays, factor = Asking(), Replays(), torch.ones(3, requires_grad=True)
    network.modes = []
    with torch.no_grad():
        found = replays.run(network, torch.ones(3))
    (factor * found).sum().backward()
    assert factor.grad is not None
    assert factor.grad.tolist() == [2.0, 2.0, 2.0]
    assert replays.run(network, factor).requires_grad
    assert network.modes == [True, False]


def test_constants_that_move_to_a_device_in_inference_mode_serve_where_gradients_are_recorded() -> None:
    with torch.inference_mode():
        moved = constant_on(torch.ones(2), torch.device("meta"))
    assert not moved.is_inference()


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_a_prior_that_was_sampled_in_inference_mode_is_trained_afterwards(process: str) -> None:
    prior = tiny_prior("dimsum_table", process=process)
    with torch.inference_mode():
        prior.sample(2, num_steps=3)
    policy = DenoisingPolicy(prior, 3)
    x = prior.initial(2, prior.scene_type.slots)
    for step in range(2):
        action, _ = policy.draw(x, step)
        policy.log_prob(x, step, action).sum().backward()
    gradients = [weight.grad for weight in prior.parameters() if weight.grad is not None]
    assert gradients
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)
