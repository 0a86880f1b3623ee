"""Rewards in worker processes that can be ended, so that a failing reward harms no run."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from rewards.base import RewardContext, RewardOutput, declared_maximum, facts_of, learned_parts
from rewards.evaluation import DRAW, evaluate_reward, other_draw, seeded_generators
from rewards.registry import (
    RewardInfo,
    allow_local_rewards,
    allow_reward_targets,
    allowed_files,
    allowed_targets,
    is_local,
    is_own,
    local_files,
    plugin_module,
    registered_module,
    resolve_reward,
    reward_info,
    reward_name,
)
from scene_envs.envs.settings import takes
from scene_envs.errors import (
    Checked,
    InvalidInputError,
    Positive,
    RewardError,
    RewardTimeoutError,
    SceneEnvsError,
    UnknownNameError,
)
from scene_envs.physics import PhysicsPool, make_pool
from scene_envs.registry import describe_error
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, register_scene_type
from scene_envs.workers import START_UP, Process, WorkerFailure


@dataclass(frozen=True, kw_only=True)
class ProcessSettings(Checked):
    """Settings of a reward that runs in a worker process.

    Attributes:
        timeout: seconds that a call may take, and that making the reward may take.
        memory: GiB that it may allocate beyond what an empty worker needs (on Linux; elsewhere unlimited).
        seed: seed of the run, for rewards that draw random numbers.
        workers: physics workers of a reward that asks for ``context.pool``; 0 computes in its process.
        physics: engine of that pool.

    Raises:
        InvalidInputError: a limit is no positive number.
    """

    timeout: Positive = 60.0
    memory: Positive = 1.0
    seed: int = 0
    workers: int = 0
    physics: str = "auto"


class IsolatedReward:
    """A reward that runs in a worker process.

    Scores are those of the same reward in this process, bit for bit. A call that takes too long, ends its process,
    crashes or fills its memory raises a :class:`~scene_envs.errors.RewardError`, so that its scenes are invalid; the
    next call gets a new process.

    Args:
        reward: a registered name, ``PATH.py:NAME`` or a mapping; objects cannot be sent.
        **settings: fields of :class:`ProcessSettings`.

    Raises:
        InvalidInputError: ``reward`` is no valid reward, or a limit is no positive number.
        RewardError: the reward cannot be made, or not in time.

    >>> with IsolatedReward("object_count", timeout=60.0) as reward:  # doctest: +SKIP
    ...     reward(SceneBatch.empty("dimsum_table", 2), RewardContext()).value
    tensor([1., 1.])
    >>> IsolatedReward(len)
    Traceback (most recent call last):
    scene_envs.errors.InvalidInputError: only a reward given by name or as a mapping can be isolated, got <built-in ...>
    """

    @takes(ProcessSettings)
    def __init__(self, reward: Any, **settings: Any) -> None:
        if not isinstance(reward, str | Mapping):
            raise InvalidInputError(f"only a reward given by name or as a mapping can be isolated, got {reward!r}")
        self.settings = ProcessSettings(**settings)
        self.name = self.__name__ = reward_name(reward)
        self._reward = reward
        self._worker: Process | None = None
        self._lock = threading.Lock()
        self._started()

    def __enter__(self) -> IsolatedReward:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"IsolatedReward({self._reward!r})"

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Score in the worker; the batch may be on any device."""
        scenes = batch.tensor.detach().cpu().contiguous().numpy()
        facts = context.prompts, self.settings.seed if context.seed == 0 else context.seed, DRAW.get()
        body = self._ask("score", replace(batch.scene_type), scenes, facts)

        def tensor(array: Any) -> Any:
            return torch.from_numpy(np.array(array)).to(batch.tensor.device)

        return RewardOutput(**mapped(tensor, np.ndarray, body))

    def maximum(self, slots: int, free_slots: int) -> float | None:
        """The largest value that the reward declares; see :func:`rewards.base.declared_maximum`."""
        found: float | None = self._ask("maximum", slots, free_slots)
        return found

    @property
    def described_by(self) -> list[Any]:
        """What tells this reward from others: what names it, and a digest of its files."""
        digest = hashlib.blake2b(digest_size=8)
        for path in local_files(self._reward):
            digest.update(path.read_bytes() if path.is_file() else b"")
        return [self._reward, digest.hexdigest()]

    def close(self) -> None:
        """End the worker; the next call starts another."""
        if self._worker is not None:
            self._worker.stop()
            self._worker = None

    def _ask(self, *message: Any) -> Any:
        with self._lock:
            return _answer(self._started(), self.name, message, self.settings.timeout)

    def _started(self) -> Process:
        if self._worker is None or not self._worker.is_alive:
            self._worker = _start(self.name, self.settings.memory)
            try:
                message = ("make", self._reward, allowed_targets(), allowed_files(), self.settings)
                vars(self).update(_answer(self._worker, self.name, message, self.settings.timeout))
            except BaseException:
                self.close()
                raise
        return self._worker


def _start(name: str, memory: float) -> Process:
    """A process for a reward that may allocate ``memory`` GiB beyond what it needs to start."""
    threads = torch.get_num_threads()  # sums of floats depend on it
    worker = Process(
        f"{__name__}:RewardRunner",
        (threads,),
        memory=int(memory * 2**30),
        environment={"PYTHONHASHSEED": "0"},
        stdout=2,  # what a reward prints goes to stderr
    )
    _answer(worker, name)
    return worker


def _answer(worker: Process, name: str, message: Any = None, timeout: float = START_UP) -> Any:
    """The answer to a message, or to the start; raises RewardError and what the reward's process raises."""
    try:
        if message is not None:
            worker.send(message, timeout)
        return worker.answer()
    except WorkerFailure as failure:
        if not failure.is_late:
            raise RewardError(f"reward {name!r} {failure}") from None
        raise RewardTimeoutError(
            f"reward {name!r} took longer than reward_limits.timeout={timeout:g} s; its process was ended"
        ) from None


class RewardRunner:
    """Answers of the process of a reward, with a number of threads of torch."""

    def __init__(self, threads: int) -> None:
        torch.set_num_threads(threads)
        self.reward: Any = None
        self.pool: PhysicsPool | None = None

    def __call__(self, message: tuple[Any, ...]) -> Any:
        """Call the method that the message names; raises InvalidInputError, UnknownNameError and RewardError alone."""
        method, *arguments = message
        try:
            return reward_info(*arguments) if method == "describe" else getattr(self, method)(*arguments)
        except MemoryError:
            raise RewardError("the reward took more memory than reward_limits.memory allows") from None
        except SceneEnvsError as error:
            cause = error.__cause__
            lacked = isinstance(cause, RuntimeError) and "allocate memory" in str(cause)
            hint = "; reward_limits.memory= allows more" if lacked or isinstance(cause, MemoryError) else ""
            kind = type(error) if type(error) in (InvalidInputError, UnknownNameError) else RewardError
            raise kind(f"{error}{hint}") from None
        except BaseException as error:
            raise RewardError(f"the reward raised {describe_error(error)}") from None

    def make(self, reward: Any, targets: list[str], files: list[Any], settings: ProcessSettings) -> dict[str, bool]:
        """Make the reward, with generators seeded from the run's; returns its facts."""
        for target in targets:
            allow_reward_targets(target)
        for file in files:
            allow_local_rewards(file)
        with seeded_generators(settings.seed):
            self.reward = resolve_reward(reward)
        for part in learned_parts(self.reward):
            raise InvalidInputError(
                f"reward {reward_name(part)!r} learns in the process of a run, but {reward_name(self.reward)!r} has "
                "parts of other packages and runs in a process of its own; combine it with this package's rewards alone"
            )
        self.pool = make_pool(settings.workers, physics=settings.physics)
        return facts_of(self.reward)

    def maximum(self, slots: int, free_slots: int) -> float | None:
        return declared_maximum(self.reward, slots, free_slots)

    def score(self, scene_type: Any, scenes: Any, facts: tuple[Any, int, int]) -> dict[str, Any]:
        """Score one batch; returns the fields of the output, as arrays."""
        prompts, seed, draw = facts
        try:
            known = get_scene_type(scene_type.name)
        except SceneEnvsError:
            known = register_scene_type(scene_type)
        batch = SceneBatch(torch.from_numpy(scenes), known if known == scene_type else scene_type)
        context = RewardContext(prompts=prompts, pool=self.pool, seed=seed)
        with other_draw(draw):
            output = evaluate_reward(self.reward, batch, context, strict=True)
        fields: dict[str, Any] = mapped(lambda tensor: tensor.cpu().numpy(), torch.Tensor, vars(output))
        return fields


def mapped(change: Callable[[Any], Any], kind: type, part: Any) -> Any:
    """``part`` with ``change`` applied to what is of this ``kind``, in mappings too."""
    if isinstance(part, Mapping):
        return {name: mapped(change, kind, value) for name, value in part.items()}
    return change(part) if isinstance(part, kind) else part


class SeededReward:
    """A reward of this process that gets the seed of its run in its context."""

    def __init__(self, reward: Any, seed: int) -> None:
        with seeded_generators(seed):
            self.reward = resolve_reward(reward)
        self.described_by, self.name, self.seed = self.reward, reward_name(self.reward), seed
        self.maximum = partial(declared_maximum, self.reward)
        vars(self).update(facts_of(self.reward))

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Score with the seed of the run."""
        return evaluate_reward(self.reward, batch, replace(context, seed=self.seed), strict=True)


def run_reward(reward: Any, **settings: Any) -> Any:
    """A reward as runs use it: one of this package in this process, any other in a process that can be ended, except
    functions and objects, which exist in this process alone. ``settings`` are fields of :class:`ProcessSettings`.

    >>> run_reward("object_count")
    ObjectCount()
    """
    if is_foreign(reward):
        return IsolatedReward(reward, **settings)
    seed = ProcessSettings(**settings).seed
    with seeded_generators(seed):
        resolved = resolve_reward(reward)
    return resolved if isinstance(reward, str) and is_own(resolved) else SeededReward(resolved, seed)


def describe_rewards(
    names: Sequence[str], timeout: float = 60.0, memory: float = 1.0
) -> Iterator[tuple[str, RewardInfo | None, str]]:
    """Each name with its listing, or with the reason why the reward cannot be used. Rewards of installed packages are
    imported in another process, within ``timeout`` seconds and ``memory`` GiB, so that one that exits, crashes or hangs
    at its import does not hide the others.
    """
    worker: Process | None = None
    try:
        for name in names:
            try:
                if not is_foreign(name):
                    yield name, reward_info(name), ""
                    continue
                if worker is None or not worker.is_alive:
                    worker = _start(name, memory)
                yield name, _answer(worker, name, ("describe", name), timeout), ""
            except SceneEnvsError as error:
                yield name, None, str(error)
    finally:
        if worker is not None:
            worker.stop()


def close_reward(reward: Any) -> None:
    """End the worker of a reward, if it has one."""
    if isinstance(reward, IsolatedReward):
        reward.close()


def is_foreign(reward: Any) -> bool:
    """Whether a name or mapping needs code from outside this package that another process can also load.

    >>> is_foreign("object_count"), is_foreign({"name": "clip", "reward": "./mine.py:clutter", "high": 1.0})
    (False, True)
    """
    if isinstance(reward, Mapping):
        outside = not str(reward.get("_target_", "rewards.")).startswith("rewards.")
        return outside or any(map(is_foreign, reward.values()))
    if not isinstance(reward, str):
        return isinstance(reward, list | tuple) and any(map(is_foreign, reward))
    if is_local(reward):
        return True
    module = registered_module(reward) or plugin_module(reward)
    if module is None or module == "__main__" or module.split(".")[0] in ("rewards", "scene_envs", "agents"):
        return False
    return plugin_module(reward) is not None  # if not: registered by a module imported in this process alone
