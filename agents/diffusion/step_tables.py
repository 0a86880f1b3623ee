"""Explicit reverse steps: pairs of timesteps (t, t_prev) of a chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral

import torch
from torch import Tensor

from scene_envs.errors import InvalidInputError


@dataclass(frozen=True)
class StepTable:
    """Reverse steps as (t, t_prev) pairs.

    Attributes:
        timesteps: (S,) int64, strictly decreasing, within 1..T.
        previous: (S,) int64, where each step lands; the last is 0, clean data.

    >>> table = StepTable.spaced(1000, 4)
    >>> table.timesteps.tolist(), table.previous.tolist()
    ([1000, 667, 334, 1], [667, 334, 1, 0])
    """

    timesteps: Tensor
    previous: Tensor

    def __post_init__(self) -> None:
        t, previous = self.timesteps, self.previous
        chained = t.shape == previous.shape and len(t) > 0 and bool((t[1:] == previous[:-1]).all())
        if not chained or int(previous[-1]) != 0 or not bool((t > previous).all()):
            raise InvalidInputError(
                f"a step table must decrease, chain and end at 0, got {t.tolist()} -> {previous.tolist()}"
            )

    def __len__(self) -> int:
        return len(self.timesteps)

    @classmethod
    def spaced(cls, num_timesteps: int, num_steps: int) -> StepTable:
        """``num_steps`` steps evenly spaced over 1..T, both ends included; any number from 1 to T.

        The timesteps are one above those of diffusers' schedulers with ``timestep_spacing="linspace"``, which count
        from 0.

        Args:
            num_timesteps: T of the schedule.
            num_steps: S; need not divide T.

        Raises:
            InvalidInputError: ``num_steps`` is not a whole number in 1..T.
        """
        if not isinstance(num_steps, Integral) or isinstance(num_steps, bool):
            raise InvalidInputError(f"num_steps={num_steps!r} must be a whole number in 1..{num_timesteps}")
        if not 1 <= num_steps <= num_timesteps:
            raise InvalidInputError(f"num_steps={num_steps} is outside 1..{num_timesteps}, the prior's timesteps")
        if num_steps == 1:
            t = torch.tensor([num_timesteps])
        else:
            t = torch.linspace(num_timesteps - 1, 0, num_steps, dtype=torch.float64).round().long() + 1
        return cls(t, torch.cat([t[1:], torch.zeros(1, dtype=torch.int64)]))

    @classmethod
    def gradual(cls, masked: Tensor, slots: int, num_steps: int) -> StepTable:
        """``num_steps`` steps, of which the first ones decide about one slot each.

        Slots that are unmasked in one step do not know each other's categories. The categories of the first slots
        determine the kind of scene, so these slots are decided one after the other. As many steps as ``num_steps``
        exceeds 25, but at most half of all steps, decide about one slot each. The other steps are evenly spaced.

        Args:
            masked: (T + 1,) share of masked slots at each timestep, non-decreasing, as of an absorbing chain.
            slots: N of a scene.
            num_steps: S, from 1 to T.

        >>> StepTable.gradual(torch.linspace(0, 1, 1001), 100, 30).timesteps[:8].tolist()
        [1000, 990, 980, 971, 961, 951, 911, 872]
        """
        num_timesteps = len(masked) - 1
        even = cls.spaced(num_timesteps, num_steps)
        single = max(0, min(num_steps // 2, num_steps - 25))
        shares = 1.0 - torch.arange(single + 1, dtype=torch.float64) / slots
        first = torch.searchsorted(masked.double().cpu(), shares.clamp(min=0.0))  # the earliest level with that share
        first = first[(first >= even.timesteps[: len(first)])].unique().flip(0)
        rest = num_steps - len(first)
        if len(first) < 2 or rest < 1 or int(first[-1]) - 1 < rest:
            return even
        later = torch.linspace(int(first[-1]), 1, rest + 1, dtype=torch.float64).round().long()[1:]
        return cls.from_timesteps([*first.tolist(), *later.tolist()], num_timesteps)

    @classmethod
    def from_timesteps(cls, timesteps: Sequence[int], num_timesteps: int | None = None) -> StepTable:
        """From the timesteps alone, in decreasing order; the last step lands on 0.

        Args:
            timesteps: such as another library's, in 1..T.
            num_timesteps: T, to check the timesteps against; a process later refuses timesteps above its own T.

        Raises:
            InvalidInputError: the timesteps are not in decreasing order, or outside 1..T.
        """
        t = torch.tensor(timesteps, dtype=torch.int64)
        if num_timesteps is not None and len(t) and not 1 <= int(t.min()) <= int(t.max()) <= num_timesteps:
            raise InvalidInputError(
                f"timesteps {int(t.min())}..{int(t.max())} are outside 1..{num_timesteps}, the prior's timesteps"
            )
        return cls(t, torch.cat([t[1:], torch.zeros(1, dtype=torch.int64)]))
