"""A reduced form of the reliability benchmark: nothing lost, nothing different, nothing silent.

Kills are in ``test_reliability_kills.py``; SIGTERM, full disks and two writers are asked by tests of the packages.
"""

from collections.abc import Callable

import pytest

from benchmarks.reliability.command_lines import fuzzed_lines
from benchmarks.reliability.damaged_files import fuzzed_files
from benchmarks.reliability.figures import Figures
from benchmarks.reliability.rewards import hostile_rewards


def assert_clean(figures: Figures, tried: int) -> None:
    assert figures.tried >= tried
    assert (figures.lost, figures.different, figures.silent) == (0, 0, 0), figures.notes


@pytest.mark.slow
def test_damaged_files_are_named_or_read_as_they_were():
    assert_clean(fuzzed_files(24, seed=5), 24)


@pytest.mark.slow
@pytest.mark.usefixtures("copied_workers")
@pytest.mark.parametrize(
    ("check", "count"),
    [
        (lambda count: fuzzed_lines(count, seed=5), 12),
        (hostile_rewards, 1),
    ],
    ids=["fuzzed command lines", "hostile rewards"],
)
def test_nothing_is_lost_different_or_silent(check: Callable[[int], Figures], count: int):
    assert_clean(check(count), count)
