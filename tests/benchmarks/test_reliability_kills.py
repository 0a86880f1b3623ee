"""One SIGKILL for every family of commands that go on: nothing is lost, and nothing differs."""

import pytest

from benchmarks.reliability.copies import Started, complete
from benchmarks.reliability.small_commands import RESUMABLE, digests, shorter, undisturbed, words_of

FAMILIES = ("generate", "pretrain", "post-train", "search", "search count")


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
