"""What cannot be is refused before torch is imported."""

import subprocess
import sys

import pytest

from agents.cli.early_checks import known_rewards, shipped_priors
from agents.priors import list_priors
from rewards import list_rewards
from rewards.registry import registered_module

LINES = {
    "evaluate workers=-1": "workers=-1: give a number of processes",
    "evaluate prior=dimsum_tabel": "did you mean 'dimsum_table'",
    "doctor reward=object_cuont": "did you mean 'object_count'",
    "search objective=object_cuont": "did you mean 'object_count'",
    "demo workers=-3": "workers=-3: give a number of processes",
    "evaluate count=0": "an evaluation needs count >= 2",
    "project scenes=nowhere": "no scene file, run or dataset is there",
    "export scenes=nowhere": "no scene file, run or dataset is there",
    "complete scenes=nowhere": "no scene file, run or dataset is there",
}


@pytest.mark.slow
def test_names_paths_and_numbers_are_refused_without_torch():
    code = (
        "import sys\nfrom agents.cli import main\n"
        f"statuses = [main(line.split()) for line in {list(LINES)!r}]\n"
        "assert set(statuses) == {2}, statuses\nassert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for line, told in zip(LINES.values(), done.stderr.splitlines(), strict=True):
        assert line in told


def test_the_names_that_are_known_without_torch_are_those_of_the_packages():
    assert shipped_priors() == list_priors()
    own = {name for name in list_rewards() if (registered_module(name) or "").startswith("rewards.")}
    assert len(own) > 15
    assert own <= set(known_rewards())
