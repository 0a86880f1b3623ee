"""Check of the contract of planners: states can be stored, sent elsewhere and expanded in any order."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
from torch import Tensor

from scene_envs.errors import SceneEnvsError

_PLAIN = (bool, int, float, complex, str, bytes, type(None), np.ndarray, np.generic, Tensor, PurePath)
_ROUNDING = 1e-3
"""Largest difference (m) between copies of a scene made in different batches: the rounding of a network."""


class NotBranchableError(SceneEnvsError):
    """A search environment breaks the contract that planners rely on."""


def check_branchable(env: Any, *, seed: int = 0, children: int = 3) -> None:
    """Check that trees over ``env`` are well defined; resets ``env``.

    States are immutable, picklable and hold plain data alone (no simulator, no network). :meth:`restore_state` brings a
    state back. Values are in [0, 1]. A child depends on its parent and the action alone: siblings made in another
    order, in other batches, after other work or from a pickled parent are the same up to the rounding of a network.
    Expansion changes neither the current state of ``env`` nor the state that is expanded.

    Args:
        env: Environment with ``reset``, ``clone_state``, ``restore_state``, ``legal_actions``, ``expand``,
            ``expand_batch`` and ``evaluate``, such as ``SceneEnvs/Search-v0`` (wrappers are removed).
        seed: Seed of the reset.
        children: Number of siblings that are made; two of them are expanded again.

    Raises:
        NotBranchableError: a rule of the contract is broken; the message names it.

    >>> from scene_envs.envs import SearchEnv
    >>> check_branchable(SearchEnv(objective="object_count", num_steps=2, slots=6))
    """
    env = getattr(env, "unwrapped", env)
    env.reset(seed=seed)
    root = env.clone_state()
    _check_state(env, root, "root")
    actions = list(env.legal_actions(root))[:children]
    _require(bool(actions), "the root has no legal action: nothing can be branched")
    before = pickle.dumps(root)
    together = env.expand_batch([(root, action) for action in actions])
    _require(len(together) == len(actions), "expand_batch gives another number of children than it was given pairs")
    _require(pickle.dumps(root) == before, "expanding a state changes it")
    _require(_same(env.clone_state(), root), "expanding moves the current state of the environment")
    for child in together:
        _check_state(env, child, "child")
    sent = pickle.loads(before)
    for action, child in reversed(list(zip(actions, together, strict=True))):
        _require(
            _same(env.expand(sent, action), child), f"the child of action {action} depends on when or how it is made"
        )
    parents = [child for child in together if len(env.legal_actions(child))][:2]
    pairs = [(parent, next(iter(env.legal_actions(parent)))) for parent in parents]
    grown = env.expand_batch(pairs)
    alone = [env.expand(*pair) for pair in reversed(pairs)][::-1]
    _require(all(map(_same, grown, alone)), "a grandchild depends on the order in which branches are expanded")
    for child in together:
        env.restore_state(child)
        _require(_same(env.clone_state(), child), "restore_state does not bring a state back")
    env.restore_state(root)


def _check_state(env: Any, state: Any, name: str) -> None:
    try:
        copy = pickle.loads(pickle.dumps(state))
    except Exception as error:
        raise NotBranchableError(f"the {name} state cannot be pickled: {error}") from error
    for where, part in _parts(state, type(state).__name__):
        _require(isinstance(part, _PLAIN), f"{where} is a {type(part).__name__}: states hold plain data alone")
    _require(_same(copy, state), f"the {name} state is not itself after pickling")
    value = env.evaluate(state)
    _require(0.0 <= value <= 1.0, f"the value of the {name} state is {value}, outside [0, 1]")
    if is_dataclass(state):
        settable = next(iter(fields(state))).name
        try:
            setattr(state, settable, getattr(state, settable))
        except (AttributeError, TypeError):
            return
        raise NotBranchableError(f"the {name} state can be written to: make {type(state).__name__} frozen")


def _parts(value: Any, where: str) -> Iterator[tuple[str, Any]]:
    """The leaves of nested data, each with its place in the data."""
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _parts(getattr(value, field.name), f"{where}.{field.name}")
    elif isinstance(value, tuple | list | frozenset | set):
        for item in value:
            yield from _parts(item, f"{where}[]")
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _parts(item, f"{where}[{key!r}]")
    else:
        yield where, value


def _same(first: Any, second: Any) -> bool:
    """Whether two states are equal, tensors and numbers up to rounding."""
    if type(first) is not type(second):
        return False
    ours, theirs = list(_parts(first, "")), list(_parts(second, ""))
    return len(ours) == len(theirs) and all(
        where == other and _equal(a, b) for (where, a), (other, b) in zip(ours, theirs, strict=True)
    )


def _equal(first: Any, second: Any) -> bool:
    if isinstance(first, Tensor):
        first, second = first.numpy(), second.numpy()
    if isinstance(first, np.ndarray | float):
        a, b = np.asarray(first), np.asarray(second)
        return a.shape == b.shape and bool(np.allclose(a, b, rtol=0, atol=_ROUNDING, equal_nan=True))
    return bool(first == second)


def _require(holds: bool, broken: str) -> None:
    if not holds:
        raise NotBranchableError(f"not branchable: {broken}")
