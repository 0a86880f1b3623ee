"""States of the search MDP, and the seeds that make its tree reproducible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class SearchState:
    """A partial scene: what is there, what will be regenerated, and how it came about. Immutable and picklable.

    Attributes:
        scene: (N, D) float32 raw scene; never write into it.
        mask: (N,) bool, the slots that the next action regenerates.
        depth: actions taken since the root.
        path: those actions.
        seed: of the root; with ``path`` it fixes all random numbers of this state and of those below it.
        value: Φ in [0, 1]; the parent's where ``valid`` is False.
        objective: the objective's raw value; 0 where not valid.
        valid: whether the objective could score this scene.

    Two states are equal when they are the same node: same seed, path and scene.
    """

    scene: Tensor
    mask: Tensor
    depth: int
    path: tuple[int, ...]
    seed: int
    value: float
    objective: float
    valid: bool

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SearchState):
            return NotImplemented
        same_node = (self.seed, self.path) == (other.seed, other.path)
        return same_node and torch.equal(self.scene, other.scene) and torch.equal(self.mask, other.mask)

    def __hash__(self) -> int:
        return hash((self.seed, self.path))


@dataclass(frozen=True)
class NodeRandomness:
    """The two independent sources of random numbers of one node of the tree.

    Attributes:
        noise: torch generator for the diffusion that makes the node's scene.
        mask: NumPy generator for its mask.
    """

    noise: torch.Generator
    mask: np.random.Generator

    @classmethod
    def at(cls, seed: int, path: tuple[int, ...]) -> NodeRandomness:
        """The sources of the node at ``path`` below the root of ``seed``: a function of these two alone.

        >>> a, b = NodeRandomness.at(7, (0, 2)), NodeRandomness.at(7, (0, 2))
        >>> a.noise.initial_seed() == b.noise.initial_seed()
        True
        """
        noise, mask = np.random.SeedSequence(entropy=seed, spawn_key=path).spawn(2)
        return cls(
            torch.Generator().manual_seed(int(noise.generate_state(1, np.uint64)[0] >> np.uint64(1))),
            np.random.default_rng(mask),
        )
