"""A reduced form of the reliability benchmark: nothing lost, nothing different, nothing silent.

SIGTERM, full disks and two writers are asked by tests of the packages.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from benchmarks.reliability.command_lines import fuzzed_lines
from benchmarks.reliability.copies import Started, complete
from benchmarks.reliability.damaged_files import fuzzed_files
from benchmarks.reliability.figures import Figures
from benchmarks.reliability.rewards import hostile_rewards
from benchmarks.reliability.small_commands import RESUMABLE, digests, shorter, undisturbed, words_of


def assert_clean(figures: Figures, tried: int) -> None:
    assert figures.tried >= tried
    assert (figures.lost, figures.different, figures.silent) == (0, 0, 0), figures.notes


@pytest.mark.slow
def test_damaged_files_are_named_or_read_as_they_were():
    assert_clean(fuzzed_files(24, seed=5), 24)


@pytest.mark.slow
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


FAMILIES = ("pretrain", "search count")


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_a_killed_command_goes_on_to_the_result_of_an_undisturbed_one(name, tmp_path):
    command = shorter(RESUMABLE[name])
    expected, words = undisturbed(command, runs=1), words_of(command, tmp_path / "run")
    killed = 0
    for share in (0.6, 0.3, 0.1, 0.02):  # the first runs in this process fill caches: later ones are faster
        started = Started(words)
        if started.wait(share * expected.seconds) is None:
            started.end()
            killed += 1
            break
    assert killed
    done = complete(words, seconds=120)
    assert done.status == 0, done.told
    assert digests(tmp_path / "run", command) == expected.digests
