"""Step tables: the pairs of timesteps (t, t_prev) of a reverse chain."""

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
        previous: (S,) int64, timestep at which each step ends; the last is 0, clean data.

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
            num_timesteps: number T of timesteps of the schedule.
            num_steps: number S of steps; need not divide T.

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
        """``num_steps`` steps, the first of which unmask about one slot each.

        The first k = min(num_steps // 2, num_steps - 25) steps unmask about one slot each; the rest are evenly spaced.
        Slots that are unmasked in one step are drawn independently, and the first slots determine the kind of scene.

        Args:
            masked: (T + 1,) share of masked slots at each timestep of an absorbing chain, non-decreasing.
            slots: number N of slots of a scene.
            num_steps: number S of steps, from 1 to T.

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
        """Table of timesteps in decreasing order; the last step ends at 0.

        Args:
            timesteps: timesteps in 1..T, such as those of another library.
            num_timesteps: T, against which the timesteps are checked; a process refuses timesteps above its own T.

        Raises:
            InvalidInputError: the timesteps are not in decreasing order, or outside 1..T.
        """
        t = torch.tensor(timesteps, dtype=torch.int64)
        if num_timesteps is not None and len(t) and not 1 <= int(t.min()) <= int(t.max()) <= num_timesteps:
            raise InvalidInputError(
                f"timesteps {int(t.min())}..{int(t.max())} are outside 1..{num_timesteps}, the prior's timesteps"
            )
        return cls(t, torch.cat([t[1:], torch.zeros(1, dtype=torch.int64)]))
