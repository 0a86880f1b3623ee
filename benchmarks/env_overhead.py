"""Cost of the environment adapters over a bare sampling loop with the same prior.

    python benchmarks/env_overhead.py [--prior dimsum_table_continuous] [--batch 128] [--steps 10] [--rounds 3]

Every adapter runs the same chain as the bare loop: the prior's posterior, one normal draw a step, and the decoding and
counting of the finished scenes. Times are CPU seconds of one thread, which a busy machine disturbs little. The bare
loop is timed again in every round, and the table gives the median over rounds of adapter / bare. The single
environment is compared with a bare loop of one scene. The process keeps freed memory. Otherwise glibc gives it back to
the kernel more or less often, depending on what else is allocated; this would hide the differences to be measured.
"""

from __future__ import annotations

import argparse
import ctypes
import statistics
import time
from collections.abc import Callable, Sequence

import gymnasium as gym
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from rewards import RewardContext, evaluate_reward, resolve_reward
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.envs.spaces import resolve_scene_and_prior
from scene_envs.protocols import PriorLike
from scene_envs.scene import SceneBatch

ENV_ID = "scene_envs:SceneEnvs/Denoising-v0"


def bare_loop(prior: PriorLike, batch: int, steps: int) -> Callable[[], None]:
    """The chain as one would write it without an environment."""
    reward, table, scene_type = resolve_reward("object_count"), prior.step_table(steps), prior.scene_type

    @torch.no_grad()
    def run() -> None:
        x = prior.initial(batch, scene_type.slots)
        for step in range(steps):
            x = prior.transition(x, step, table).from_noise(torch.randn_like(x))
        scenes = SceneBatch.from_tensor(prior.clamp(x), scene_type, normalised=prior.normalizer)
        evaluate_reward(reward, scenes, RewardContext())

    return run


def ancestral(prior: PriorLike, steps: int) -> Callable[[Tensor, int], Tensor]:
    """The prior as a policy of ``next_sample`` mode."""
    table = prior.step_table(steps)

    def policy(x: Tensor, step: int) -> Tensor:
        result: Tensor = prior.transition(x, step, table).from_noise(torch.randn_like(x))
        return result

    return policy


def torchrl_rollout(prior: PriorLike, batch: int, steps: int) -> Callable[[], None]:
    """``DenoisingTorchRLEnv.rollout``, next_sample mode."""
    env = DenoisingTorchRLEnv(batch, prior=prior, num_steps=steps)
    policy = ancestral(prior, steps)

    @torch.no_grad()
    def run() -> None:
        taken = iter(range(steps))

        def act(tensordict: TensorDictBase) -> TensorDictBase:
            return tensordict.set("action", policy(tensordict["scene"], next(taken)))

        env.rollout(steps, act)

    return run


def gymnasium_vector(prior: PriorLike, batch: int, steps: int) -> Callable[[], None]:
    """``DenoisingVectorEnv``, noise mode; one step of an episode is spent on the autoreset."""
    env = gym.make_vec(ENV_ID, num_envs=batch, prior=prior, num_steps=steps, action_mode="noise")
    env.reset(seed=0)
    shape = env.action_space.shape or ()

    def run() -> None:
        for _ in range(steps):
            env.step(torch.randn(shape).numpy())

    return run


def gymnasium_single(prior: PriorLike, steps: int) -> Callable[[], None]:
    """``DenoisingEnv``, noise mode, one scene."""
    env = gym.make(ENV_ID, prior=prior, num_steps=steps, action_mode="noise").unwrapped
    shape = env.action_space.shape or ()

    def run() -> None:
        env.reset()
        for _ in range(steps):
            env.step(torch.randn(shape).numpy())

    return run


def keep_freed_memory() -> None:
    """Tell glibc, where there is one, neither to trim the heap nor to map large blocks separately."""
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-1, 1 << 30)  # M_TRIM_THRESHOLD
        libc.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD
    except (OSError, AttributeError):
        print("no glibc: times include the kernel's work for freed memory")


def cpu_seconds(run: Callable[[], None]) -> float:
    """CPU time of one call."""
    start = time.process_time()
    run()
    return time.process_time() - start


def compare(bare: Callable[[], None], adapters: Sequence[tuple[str, Callable[[], None]]], rounds: int) -> list[str]:
    """One row per adapter: median CPU seconds, median ratio to the bare loop of the same round."""
    times: dict[str, list[float]] = {name: [] for name, _ in adapters}
    base: list[float] = []
    for _, run in (("bare", bare), *adapters):
        run()  # warm up
    for _ in range(rounds):
        base.append(cpu_seconds(bare))
        for name, run in adapters:
            times[name].append(cpu_seconds(run))
    rows = [f"| bare loop | {statistics.median(base):.3f} | 1.000 |"]
    for name, _ in adapters:
        ratio = statistics.median(np.array(times[name]) / np.array(base))
        rows.append(f"| {name} | {statistics.median(times[name]):.3f} | {ratio:.3f} |")
    return rows


def main() -> None:
    """Parse the arguments, run, print a Markdown table."""
    parser = argparse.ArgumentParser(description="Overhead of the environment adapters over a bare sampling loop.")
    parser.add_argument("--prior", default="dimsum_table_continuous", help="name or path; 'tiny' for an untrained one")
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    keep_freed_memory()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    if arguments.prior == "tiny":
        from agents.priors.testing import tiny_prior

        given: object = tiny_prior()
    else:
        given = arguments.prior
    _, prior = resolve_scene_and_prior("dimsum_table", given)
    batch, steps, rounds = arguments.batch, arguments.steps, arguments.rounds
    batched = (
        ("torchrl, rollout", torchrl_rollout(prior, batch, steps)),
        ("gymnasium vector", gymnasium_vector(prior, batch, steps)),
    )
    print(f"B = {batch}, {steps} steps, prior {arguments.prior}, one thread, median of {rounds} rounds\n")
    header = ["| adapter | CPU s per batch of episodes | ratio to bare loop |", "|---|---|---|"]
    print("\n".join([*header, *compare(bare_loop(prior, batch, steps), batched, rounds)]))
    single = (("gymnasium single, B = 1", gymnasium_single(prior, steps)),)
    print("\n".join(compare(bare_loop(prior, 1, steps), single, 5 * rounds)))


if __name__ == "__main__":
    main()
