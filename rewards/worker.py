"""A worker process of one reward: ``python -m rewards.worker READ_FD WRITE_FD TIMEOUT MEMORY THREADS``.

It is told which reward to make, then scores one batch per message. It ends when its pipe closes, even while the reward
works.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
from multiprocessing.connection import Connection
from typing import Any

import torch

from rewards.base import RewardContext, averages_objects, counts_objects, declared_maximum, depends_on_batch
from rewards.evaluation import describe_error, evaluate_reward
from rewards.learned import learned_parts
from rewards.local_files import allow_local_rewards
from rewards.registry import RewardInfo, allow_reward_targets, resolve_reward, reward_info, reward_name
from rewards.reward_process import packed
from rewards.seeding import other_draw, seeded_generators
from scene_envs.errors import InvalidInputError, SceneEnvsError
from scene_envs.physics import PhysicsPool
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, register_scene_type

_GRACE = 5
"""Seconds after the time limit of a call at which the process ends itself, if its parent has not ended it."""


def serve(inbox: Connection, outbox: Connection, timeout: float) -> None:
    """Answer messages until the other end closes."""
    answer, process = _Answers(), os.getpid()
    outbox.send((0, "done", None))
    while True:
        try:
            number, kind, *body = inbox.recv()
        except EOFError:
            return
        except OSError:  # the reward closed the pipe
            os._exit(1)
        signal.setitimer(signal.ITIMER_REAL, timeout + _GRACE)  # the default action ends even code that holds the GIL
        try:
            reply: tuple[str, Any] = ("done", getattr(answer, kind)(*body))
        except MemoryError:
            reply = ("failed", ("RewardError", "the reward took more memory than reward_memory= allows"))
        except SceneEnvsError as error:
            hint = "; reward_memory= allows more" if _lacked_memory(error) else ""
            reply = ("failed", (type(error).__name__, f"{error}{hint}"))
        except BaseException as error:
            reply = ("failed", ("RewardError", f"the reward raised {describe_error(error)}"))
        if os.getpid() != process:  # a copy that the reward forked came back here: it must not answer
            os._exit(0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        try:
            outbox.send((number, *reply))
        except OSError:
            os._exit(1)


def _lacked_memory(error: BaseException) -> bool:
    cause = error.__cause__
    return isinstance(cause, MemoryError) or (isinstance(cause, RuntimeError) and "allocate memory" in str(cause))


class _Answers:
    """Calls that the parent may make."""

    def __init__(self) -> None:
        self.reward: Any = None
        self.pool: PhysicsPool | None = None

    def make(self, reward: Any, targets: list[str], files: list[Any], workers: int, seed: int) -> tuple[bool, ...]:
        """Make the reward, with generators seeded from the run's.

        Returns whether it depends on the batch, averages objects, and counts objects.
        """
        for target in targets:
            allow_reward_targets(target)
        for file in files:
            allow_local_rewards(file)
        with seeded_generators(seed):
            self.reward = resolve_reward(reward)
        for part in learned_parts(self.reward):
            raise InvalidInputError(
                f"reward {reward_name(part)!r} learns in the process of a run, but {reward_name(self.reward)!r} has "
                "parts of other packages and runs in a process of its own; combine it with this package's rewards alone"
            )
        self.pool = PhysicsPool(workers=workers) if workers else None
        made = self.reward
        return depends_on_batch(made), averages_objects(made), counts_objects(made)

    def maximum(self, slots: int, free_slots: int) -> float | None:
        """The largest value that the reward declares."""
        return declared_maximum(self.reward, slots, free_slots)

    def describe(self, name: str) -> RewardInfo:
        """The listing of a reward, whose plug-in is imported."""
        return reward_info(name)

    def score(self, scene_type: Any, scenes: Any, facts: tuple[Any, int, int]) -> dict[str, Any]:
        """Score one batch."""
        prompts, seed, draw = facts
        try:
            known = get_scene_type(scene_type.name)
        except SceneEnvsError:
            known = register_scene_type(scene_type)
        batch = SceneBatch(torch.from_numpy(scenes), known if known == scene_type else scene_type)
        context = RewardContext(prompts=prompts, pool=self.pool, seed=seed)
        with other_draw(draw):
            return packed(evaluate_reward(self.reward, batch, context, strict=True))


def _watch(inbox: int) -> None:
    """End the process, and those that it started, when the other end of the pipe closes."""
    poll = select.poll()
    poll.register(inbox, 0)  # hang-ups alone
    poll.poll()
    os.killpg(os.getpgid(0), signal.SIGKILL)


def _limit(memory: int) -> None:
    """Allow ``memory`` bytes beyond what the process has now, and write no core files."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with open("/proc/self/status") as file:
            now = next(int(line.split()[1]) for line in file if line.startswith("VmData")) * 1024
        resource.setrlimit(resource.RLIMIT_DATA, (now + memory, now + memory))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    read, write = int(sys.argv[1]), int(sys.argv[2])
    torch.set_num_threads(int(sys.argv[5]))  # sums of floats depend on it
    threading.Thread(target=_watch, args=(read,), daemon=True).start()
    _limit(int(sys.argv[4]))
    serve(Connection(read, writable=False), Connection(write, readable=False), float(sys.argv[3]))
