"""Interface for planners: conformance of the search environment, and errors for environments that break it."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import pytest

from agents.priors.testing import tiny_prior
from scene_envs.envs import check_branchable
from scene_envs.envs.branchable import NotBranchableError
from tests.helpers.toy_prior import ToyPrior


@dataclass(frozen=True)
class Frozen:
    path: tuple[int, ...] = ()
    extra: Any = None


@dataclass
class Open:
    path: tuple[int, ...] = ()


@dataclass
class PathEnv:
    """A tree of paths; ``grow`` makes a child, ``value`` scores it."""

    grow: Any = lambda state, action: Frozen((*state.path, action))
    value: Any = lambda state: 0.5
    root: Any = field(default_factory=Frozen)

    def reset(self, seed: int) -> None:
        self.state = self.root

    def clone_state(self) -> Any:
        return self.state

    def restore_state(self, state: Any) -> None:
        self.state = state

    def legal_actions(self, state: Any) -> range:
        return range(4)

    def expand_batch(self, pairs: Any) -> list[Any]:
        return [self.grow(*pair) for pair in pairs]

    def expand(self, state: Any, action: int) -> Any:
        return self.grow(state, action)

    def evaluate(self, state: Any) -> float:
        return self.value(state)


def test_the_search_environment_is_branchable(free_objects: Any) -> None:
    check_branchable(gym.make("scene_envs:SceneEnvs/Search-v0", prior=ToyPrior(), objective=free_objects, num_steps=2))
    check_branchable(
        gym.make("scene_envs:SceneEnvs/Search-v0", prior=tiny_prior(), objective=free_objects, num_steps=2)
    )


def test_paths_are_branchable() -> None:
    check_branchable(PathEnv())


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (PathEnv(root=Open()), "can be written to: make Open frozen"),
        (PathEnv(root=Frozen(extra=lambda: 0)), "cannot be pickled"),
        (PathEnv(root=Frozen(extra=random.Random(0))), "Frozen.extra is a Random: states hold plain data alone"),
        (PathEnv(value=lambda state: 33.0), "33.0, outside"),
        (PathEnv(grow=lambda state, action: Frozen((action, random.randrange(10**9)))), "depends on when or how"),
    ],
)
def test_broken_promises_are_named(env: PathEnv, message: str) -> None:
    with pytest.raises(NotBranchableError, match=message):
        check_branchable(env)
