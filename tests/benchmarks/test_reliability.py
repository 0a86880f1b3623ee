"""A reduced form of the reliability benchmark: nothing lost, nothing different, nothing silent."""

import pytest

from benchmarks.reliability import Figures, fuzzed_files, fuzzed_lines, hostile_rewards, kills, two_writers


def assert_clean(figures: Figures, tried: int) -> None:
    assert figures.tried >= tried
    assert (figures.lost, figures.different, figures.silent) == (0, 0, 0), figures.notes


def test_damaged_files_are_named_or_read_as_they_were():
    assert_clean(fuzzed_files(24, seed=5), 24)


@pytest.mark.slow
def test_fuzzed_command_lines_are_refused_in_our_own_words():
    assert_clean(fuzzed_lines(20, seed=5), 20)


@pytest.mark.slow
def test_hostile_rewards_cost_their_scenes_alone():
    assert_clean(hostile_rewards(3), 3)


@pytest.mark.slow
def test_killed_commands_go_on_to_the_same_result():
    assert_clean(kills(3, seed=5), 3)


@pytest.mark.slow
def test_of_two_writers_one_works():
    assert_clean(two_writers(1), 1)
