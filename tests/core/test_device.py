"""Devices: one meaning of ``device=``, and nothing that crosses between devices in the middle of a chain."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

from agents import evaluate, run_search
from agents.cli.keys import keys_of
from agents.cli.main import load_command
from agents.configuration.composition import DeviceKeys
from agents.networks.denoisers import Denoiser
from agents.planning.gradient import Guidance, overlap
from agents.post_training import post_train
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.rollouts import collect, finished_scenes
from agents.priors.testing import tiny_prior
from rewards import RewardContext, resolve_reward
from rewards.evaluation import evaluate_reward
from scene_envs.arrays import resolve_device, within_memory
from scene_envs.envs import DenoisingTorchRLEnv, DenoisingVectorEnv
from scene_envs.envs.masks import resolve_mask
from scene_envs.envs.scoring import Score, prior_device, resolve_prior
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.fake_gpu import GPU, Crossings, fake, fake_gpu, to_gpu
from tests.helpers.small_runs import small_config

STEPS = 2


@pytest.fixture
def crossings(monkeypatch: pytest.MonkeyPatch) -> Crossings:
    with fake_gpu(monkeypatch) as counted:
        yield counted


def plain(tensor: Tensor) -> Tensor:
    return tensor.as_subclass(Tensor)


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)


# -- the fake GPU itself ------------------------------------------------------------------------


def test_the_fake_gpu_refuses_what_a_gpu_refuses_and_counts(crossings: Crossings) -> None:
    ours, theirs = fake(torch.ones(2)), torch.ones(2)
    assert ours.device == GPU
    assert ours.is_cuda
    with pytest.raises(RuntimeError, match="same device"):
        ours + theirs
    with pytest.raises(TypeError, match="numpy"):
        ours.numpy()
    assert not crossings.to_host
    assert not crossings.to_gpu
    assert torch.equal(ours.cpu(), theirs)
    assert (theirs.to("cuda") + ours).device == GPU
    assert (ours * 2.0 + torch.tensor(1.0)).device == GPU  # a number crosses with the kernel
    assert float(ours.sum()) == 2.0
    assert ours[[0, 1]].shape == (2,)
    assert crossings.to_host.total() == 1
    assert crossings.to_gpu.total() == 2
    assert crossings.reads.total() == 1


# -- chains -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("process", "text"), [("continuous", False), ("mixed", False), ("mixed", True)])
def test_a_chain_stays_on_its_device(process: str, text: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between x_T and x_0 nothing is copied, once the constants are there; the scenes are those of the CPU."""
    prior, how = tiny_prior(process=process, text=text), {"num_steps": STEPS, "seed": 3}
    if text:
        how |= {"prompt": "A scene with two cups.", "guidance": 1.0}
    expected = prior.sample(2, **how)
    with fake_gpu(monkeypatch) as crossings:
        to_gpu(prior)
        prior.sample(2, **how)  # constants are copied
        assert "arrays.py:constant_on" in crossings.to_gpu
        table = prior.step_table(STEPS)
        encoded = prior.encode_prompts(["A scene with two cups."] * 2) if text else None
        x = prior.initial(2, 34, torch.Generator("cuda").manual_seed(0))
        crossings.clear()
        x = prior.run_chain(x, table, None, text=encoded, guidance=1.0 if text else 0.0)
        words = dict.fromkeys(("text.py:encode", "mixed.py:encode_prompts"), 1) if text else {}  # of the empty prompt
        assert (crossings.to_host, crossings.to_gpu, crossings.reads) == ({}, words, {})
        batch = prior.sample(2, **how)
    assert x.device == GPU
    # attention to texts has another form on a CPU
    assert torch.allclose(plain(batch.tensor), expected.tensor, rtol=0, atol=1e-4)  # GELU rounds otherwise on a CPU


def test_guidance_by_claims_numbers_and_gradients_stays_on_its_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps copy nothing, and read only that scenes are valid."""
    prompts = ["A scene where two cups are each on top of a plate.", "A scene where the teapot is behind the cup."]
    prior = tiny_prior("dimsum_table", process="mixed", text=True, kernel="squared_absorbing")
    gradient = Guidance(overlap, 1.0, 0.0)
    kept = torch.zeros(2, 34, dtype=torch.bool)
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 2)
    how = {"prompt": prompts, "claim_guidance": 2.0, "guide": gradient, "num_steps": STEPS}
    expected = prior.inpaint(scenes, ~kept, **how)
    with fake_gpu(monkeypatch) as crossings:
        to_gpu(prior)
        there, free = scenes.to("cuda"), fake(~kept)
        counts = []
        for steps in (STEPS, 2 * STEPS, 2 * STEPS, STEPS):  # the first two copy constants
            crossings.clear()
            batch = prior.inpaint(there, free, **how | {"num_steps": steps})
            del crossings.to_gpu["prior.py:draw_noise"]  # one generator for each scene, on the CPU
            for check in ("_require_scene_tensor", "from_parts"):  # that new scenes are finite, with known categories
                del crossings.reads[f"scene.py:{check}"]
            counts.append([dict(each) for each in (crossings.to_host, crossings.to_gpu, crossings.reads)])
    assert counts[2] == counts[3]  # whatever the number of steps
    torch.testing.assert_close(plain(batch.tensor), expected.tensor, atol=1e-4, rtol=0)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_inpainting_stays_on_its_device(process: str, scenes: SceneBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    prior, mask = tiny_prior(process=process), torch.arange(34).expand(3, -1) % 2 == 0
    expected = prior.inpaint(scenes, mask, num_steps=STEPS)
    counts = []
    with fake_gpu(monkeypatch) as crossings:
        to_gpu(prior)
        prior.inpaint(scenes.to("cuda"), fake(mask), num_steps=STEPS)
        for steps in (STEPS, 2 * STEPS):
            prior.inpaint(scenes.to("cuda"), fake(mask), num_steps=steps)
            crossings.clear()
            batch = prior.inpaint(scenes.to("cuda"), fake(mask), num_steps=steps)
            noise = crossings.to_gpu.pop("prior.py:draw_noise")  # one generator for each scene, on the CPU
            counts.append((noise, crossings.to_host.total(), crossings.to_gpu.total(), crossings.reads.total()))
        batch = prior.inpaint(scenes.to("cuda"), fake(mask), num_steps=STEPS)
    assert counts[0][1:] == counts[1][1:]  # whatever the number of steps
    torch.testing.assert_close(plain(batch.tensor), expected.tensor, atol=1e-5, rtol=0)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_a_batch_of_post_training_stays_on_its_device(process: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """From reset to the score: no state, action or flag is copied, and as many numbers are read at every step."""

    def batches(prior: object, steps: int) -> Iterator[tuple[Tensor, Tensor]]:
        env = DenoisingTorchRLEnv(3, prior=prior, num_steps=steps, reward="object_count")
        while True:
            made = collect(env, DenoisingPolicy(prior, steps), seed=1)
            yield finished_scenes(made).tensor, made["next", "reward"]

    prior, reads = tiny_prior(process=process), {}
    expected = next(batches(prior, STEPS))
    with fake_gpu(monkeypatch) as crossings:
        to_gpu(prior)
        for steps in (2 * STEPS, STEPS):
            made = batches(prior, steps)
            next(made)  # constants are copied
            crossings.clear()
            found = next(made)
            assert not crossings.to_host
            assert crossings.to_gpu.keys() <= AT_THE_ENDS
            reads[steps] = crossings.reads.total()
    assert reads[2 * STEPS] - reads[STEPS] == 4 * STEPS  # two of ours, that values are finite, and two of torchrl
    assert all(value.device == GPU for value in found)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(plain(ours), theirs, atol=1e-4, rtol=1e-4)


AT_THE_ENDS = {"mixed.py:initial_from_noise", "scene.py:is_welded"}
"""Places of a batch of episodes that copy lists of numbers to the device once: at the start, and in the score."""


@pytest.mark.parametrize(
    "reward", ["clearance", "clutter", "feasible_share", "object_count", "penetration",
               "prompt_match", "stability"],
)  # fmt: skip
def test_rewards_score_on_the_device_of_the_scenes(
    reward: str, scenes: SceneBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = RewardContext(prompts=("A scene with two cups.",) * 3)
    expected = evaluate_reward(resolve_reward(reward), scenes, context)
    with fake_gpu(monkeypatch):
        found = evaluate_reward(resolve_reward(reward), scenes.to("cuda"), context, strict=True)
        assert all(part.device == GPU for part in (found.value, found.is_valid, *found.terms.values()))
    assert torch.equal(plain(found.value), expected.value)


@pytest.mark.parametrize("mask", ["empty", "random", "balanced"])
def test_masks_are_on_the_device_of_the_scene(mask: object, scenes: SceneBatch, crossings: Crossings) -> None:
    free = scenes.is_free[:1].float()
    score = Score(torch.ones(1), torch.ones(1, dtype=torch.bool), per_object=free)
    there = Score(fake(score.value), fake(score.valid), per_object=fake(free))
    generator = resolve_mask(mask)
    expected = generator(scenes[0], score, np.random.default_rng(0))
    found = generator(scenes[0].to("cuda"), there, np.random.default_rng(0))
    assert found.device == GPU
    assert torch.equal(plain(found), expected)


def test_methods_of_scenes_keep_their_device(scenes: SceneBatch, crossings: Crossings) -> None:
    there = scenes.to("cuda")
    for made in (there.with_slots(40), there[1:], there.keeping(there.is_free), SceneBatch.concatenate([there, there]),
                 there.with_poses(there.translations, there.rotations)):  # fmt: skip
        assert made.tensor.device == GPU
    for name in ("counts", "is_free", "is_empty", "is_welded", "masses", "translations", "categories"):
        assert getattr(there, name).device == GPU
        assert torch.equal(plain(getattr(there, name)), getattr(scenes, name))


# -- the key ------------------------------------------------------------------------------------


def test_auto_is_the_gpu_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto") == torch.device("cpu")
    assert resolve_device("auto", torch.device("meta")) == torch.device("meta")  # of what exists already
    with pytest.raises(InvalidInputError, match=r"'cuda'.*use one of auto, cpu; torch finds no CUDA GPU"):
        resolve_device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert str(resolve_device("auto")) == "cuda"
    assert str(resolve_device("cuda:1")) == "cuda:1"
    for wrong in ("cuda:2", "meta", "gpu"):
        with pytest.raises(InvalidInputError, match=r"use one of auto, cpu, cuda, cuda:0, cuda:1$"):
            resolve_device(wrong)


@pytest.mark.parametrize(
    "command", ["sample", "complete", "rearrange", "search", "evaluate", "view", "export", "pretrain", "post-train",
                "doctor", "demo", "import-checkpoint"],
)  # fmt: skip
def test_every_command_that_runs_a_network_has_the_key(command: str) -> None:
    assert issubclass(keys_of(load_command(command)), DeviceKeys)


@pytest.mark.parametrize("name", ["Denoising-v0", "Search-v0", "SearchMask-v0"])
def test_environments_take_a_device(name: str) -> None:
    env = gym.make(f"scene_envs:SceneEnvs/{name}", prior=tiny_prior(), num_steps=2, device="cpu")
    assert env.unwrapped.spec.kwargs["device"] == "cpu"
    with pytest.raises(InvalidInputError, match=r"device='cuda:77' is no device of this machine"):
        gym.make(f"scene_envs:SceneEnvs/{name}", device="cuda:77")


def test_functions_refuse_a_device_that_is_not_there() -> None:
    for call in (
        lambda: evaluate("dimsum_table", 2, device="cuda:77"),
        lambda: run_search("dimsum_table", device="cuda:77"),
        lambda: DenoisingVectorEnv(1, device="cuda:77"),
    ):
        with pytest.raises(InvalidInputError, match=r"device='cuda:77' is no device of this machine"):
            call()


def test_a_given_prior_stays_where_it_is_and_a_copy_goes_elsewhere() -> None:
    prior = tiny_prior()
    assert resolve_prior(prior) is prior
    assert resolve_prior(prior, "cpu") is prior
    away = tiny_prior().to("meta")
    assert prior_device(resolve_prior(away)) == torch.device("meta")


# -- memory -------------------------------------------------------------------------------------


@pytest.fixture
def small_memory(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A network of a continuous prior that has memory for five scenes at once; the sizes of its passes."""
    sizes: list[int] = []
    run = Denoiser.output

    def bounded(self: Denoiser, x_t: Tensor, t: Tensor) -> Tensor:
        sizes.append(len(x_t))
        if len(x_t) > 5:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore of it")
        return run(self, x_t, t)

    monkeypatch.setattr(Denoiser, "output", bounded)
    return sizes


def test_a_batch_too_large_for_the_memory_names_one_that_fits(small_memory: list[int]) -> None:
    prior = tiny_prior()
    with pytest.raises(InvalidInputError, match=r"^batch_size=20 needs .*\(CUDA out of memory.*\); batch_size=5 fits$"):
        prior.sample(40, num_steps=2, batch_size=20)
    assert small_memory == [20, 10, 5, 5]
    assert len(prior.sample(7, num_steps=2, batch_size=5)) == 7


def test_a_run_too_large_for_the_memory_names_a_chunk_that_fits(small_memory: list[int], tmp_path: Path) -> None:
    config = small_config(tmp_path, batch_size=8, regularisation=0.0, chunk=None)
    with pytest.raises(InvalidInputError, match=r"^optimizer.chunk=8 needs more memory .*; optimizer.chunk=4 fits$"):
        post_train(config, prior=tiny_prior())


def test_other_errors_of_the_work_are_raised_as_they_are() -> None:
    def broken(size: int) -> None:
        raise RuntimeError("shapes do not fit")

    with pytest.raises(RuntimeError, match=r"^shapes do not fit$"):
        within_memory(broken, 4, "batch_size")
    with pytest.raises(InvalidInputError, match="not even one fits"):
        within_memory(lambda size: (_ for _ in ()).throw(MemoryError()), 4, "batch_size")
