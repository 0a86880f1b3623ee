"""Hostile rewards that exit, hang, crash, fill memory or print without end: loss of their scenes alone."""

import os
import random
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rewards import (
    IsolatedReward,
    RewardContext,
    allow_local_rewards,
    check_reward,
    evaluate_reward,
    register_reward,
    resolve_reward,
)
from rewards.process import SeededReward, is_foreign, run_reward
from scene_envs.errors import InvalidInputError, RewardError, RewardTimeoutError
from tests.helpers import hostile_rewards as hostile
from tests.helpers.trap import trapped

FILE = Path(hostile.__file__)


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (hostile.leaves, r"'leaves' called sys.exit\(0\).*hostile_rewards.py, line \d+"),
        (hostile.talks, r"'talks' raised ValueError: x+\.\.\. \(1048576 characters\).*hostile_rewards.py, line \d+"),
        (hostile.mumbles, r"'mumbles' raised Unspeakable: \(its text cannot be read\)"),
        (hostile.rewrites, r"'rewrites' changed the scenes"),
        (hostile.shrinks, r"'shrinks' changed the scenes"),
        (hostile.has_few, r"'has_few': value is torch.sparse_coo; use .to_dense"),
        (hostile.complex_numbers, r"'complex_numbers': value has dtype torch.complex64, expected a float"),
        (hostile.nameless, r"'nameless' raised Nameless: x"),
    ],
)
def test_a_hostile_reward_in_this_process_is_invalid_in_one_short_sentence(reward, message, cups):
    with pytest.raises(RewardError, match=message) as caught:
        evaluate_reward(resolve_reward(reward), cups, strict=True)
    assert len(str(caught.value)) < 700
    assert str(caught.value).count(reward.__name__) == 1
    before = cups.tensor.clone()
    assert evaluate_reward(resolve_reward(reward), cups).valid.tolist() == [False, False]
    assert torch.equal(cups.tensor, before)


def test_ctrl_c_is_not_taken_for_a_failure(cups):
    def interrupted(batch, context):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_reward(interrupted, cups)


@pytest.mark.parametrize("reward", [hostile.rewrites, hostile.shrinks])
def test_check_reward_sees_what_is_written_through_numpy(reward):
    with pytest.raises(RewardError, match="changed the scenes"):
        check_reward(reward)


def test_global_generators_are_seeded_from_the_run_and_left_as_they_were(cups):
    def scores(seed):
        return evaluate_reward(SeededReward(hostile.noisy, seed), cups).value

    before = torch.get_rng_state(), np.random.get_state()[1], random.getstate()  # noqa: NPY002
    first = scores(3)
    after = torch.get_rng_state(), np.random.get_state()[1], random.getstate()  # noqa: NPY002
    assert torch.equal(before[0], after[0])
    assert (before[1] == after[1]).all()
    assert before[2] == after[2]
    assert torch.equal(first, scores(3))
    assert not torch.equal(first, scores(4))


def test_a_reward_is_made_with_generators_seeded_from_the_run(cups):
    def scores(seed):
        return [evaluate_reward(make(hostile.DrawsWhenMade, seed), cups).value for make in (SeededReward, _made)]

    def _made(reward, seed):
        return run_reward(reward, seed=seed)

    random.seed(1)
    before = random.getstate()
    first, again, other = scores(3), scores(3), scores(4)
    assert random.getstate() == before
    assert torch.equal(first[0], first[1])
    assert torch.equal(torch.stack(first), torch.stack(again))
    assert not torch.equal(first[0], other[0])


def test_a_copy_of_the_process_that_a_reward_forks_does_not_go_on(cups, tmp_path):
    assert evaluate_reward(resolve_reward(hostile.forks), cups).valid.tolist() == [True, True]
    with (tmp_path / "processes").open("a") as file:
        file.write(f"{os.getpid()}\n")
    assert os.waitpid(-1, 0)[1] == 0  # the copy
    assert len((tmp_path / "processes").read_text().split()) == 1


def test_a_part_of_a_composite_is_named_once(cups):
    composite = resolve_reward(
        {"name": "weighted_sum", "rewards": [{"name": "clip", "reward": hostile.talks, "low": 0}]}
    )
    with pytest.raises(RewardError) as caught:
        evaluate_reward(composite, cups, strict=True)
    assert str(caught.value).count("'talks'") == 1


def test_rewards_of_this_package_and_objects_stay_in_this_process():
    assert not is_foreign("object_count")
    assert not is_foreign({"name": "weighted_sum", "rewards": ["object_count", {"name": "clutter"}]})
    assert is_foreign({"name": "product", "rewards": ["object_count", "mine.py:good"]})
    assert is_foreign({"_target_": "my_package.Mine"})
    assert run_reward("object_count") == resolve_reward("object_count")

    @register_reward("only_in_this_process")
    def mine(batch):
        return batch.counts

    assert not is_foreign("only_in_this_process")


@pytest.mark.slow
@pytest.mark.usefixtures("plugin")
def test_an_installed_reward_is_run_elsewhere():
    assert is_foreign("open_space")
    assert is_foreign({"name": "clip", "reward": "open_space", "high": 1.0})


def test_a_file_runs_only_where_it_was_allowed(tmp_path, cups):
    path = tmp_path / "mine.py"
    path.write_text("def few(batch):\n    return -batch.counts\n")
    with pytest.raises(InvalidInputError, match="--allow-local"):
        resolve_reward(f"{path}:few")
    allow_local_rewards(path)
    assert evaluate_reward(resolve_reward(f"{path}:few"), cups).value.tolist() == (-cups.counts).tolist()
    with pytest.raises(InvalidInputError, match="no function or class 'many'"):
        resolve_reward(f"{path}:many")


@pytest.mark.parametrize("limits", [{"timeout": 0}, {"timeout": "a"}, {"memory": float("nan")}, {"memory": -1}])
def test_limits_are_positive_numbers(limits):
    with pytest.raises(InvalidInputError, match="positive number"):
        run_reward("object_count", **limits)


@pytest.mark.slow
@pytest.mark.usefixtures("new_interpreters")
def test_scores_of_a_new_interpreter_are_those_of_this_process_bit_for_bit(cups, capfd, tmp_path):
    """It imports nothing else from the current folder, where the reward's file is, and its end prints no traceback."""
    shutil.copy(FILE, tmp_path / "mine.py")
    with trapped(tmp_path):
        allow_local_rewards("mine.py")
        with IsolatedReward("./mine.py:named", timeout=60, seed=5) as reward:
            for name in ("honest", "noisy"):
                context = RewardContext(prompts=(name, name))
                here = evaluate_reward(SeededReward(hostile.named, 5), cups, context)
                there = [evaluate_reward(reward, cups, context) for _ in range(2)]
                assert torch.equal(here.value, there[0].value)
                assert torch.equal(here.value, there[1].value)
            output = evaluate_reward(reward, cups, RewardContext(prompts=("closes_pipes", "closes_pipes")))
    assert output.valid.tolist() == [False, False]
    assert "Traceback" not in capfd.readouterr().err


@pytest.fixture(scope="module")
def worker():
    """One process for all hostile rewards, until one of them ends it."""
    allow_local_rewards(FILE)
    with IsolatedReward(f"{FILE}:named", timeout=20, memory=0.5) as reward:
        yield reward


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("leaves", "called sys.exit"),
        ("quits", r"ended its process \(exit status 0\)"),
        ("hangs", "took longer than reward_limits.timeout=0.3 s"),
        ("holds_the_interpreter", "took longer than reward_limits.timeout=0.3 s"),
        ("segfaults", r"crashed its process \(SIGSEGV\)"),
        ("fills_memory", "memory"),
        ("talks", "1048576 characters"),
        ("rewrites", "changed the scenes"),
        ("writes_into_pipes", "disturbed the answers of its process"),
        ("closes_pipes", r"ended its process \(exit status 1\)"),
        ("closes_pipes_and_works", r"ended its process \(exit status 1\)"),
        ("closes_pipes_and_hangs", "disturbed the answers of its process"),
    ],
)
def test_a_hostile_reward_costs_its_scenes_and_nothing_else(name, message, cups, worker):
    before = cups.tensor.clone()
    worker.settings = replace(worker.settings, timeout=20)  # in which the one before may have to be replaced
    assert evaluate_reward(worker, cups, RewardContext(prompts=("honest", "honest"))).valid.tolist() == [True, True]
    worker.settings = replace(worker.settings, timeout=0.3 if "longer" in message else 20)
    started = time.monotonic()
    output = evaluate_reward(worker, cups, RewardContext(prompts=(name, name)))
    assert time.monotonic() - started < 30  # the limit, and the end of the process
    assert output.valid.tolist() == [False, False]
    assert re.search(message, output.problem)
    assert torch.equal(before, cups.tensor)


@pytest.mark.slow
def test_a_reward_that_forks_answers_once_for_each_batch(cups, worker):
    for batch in (cups, cups.with_slots(9), cups[:1]):
        names = ("forks",) * len(batch)
        assert torch.equal(
            evaluate_reward(worker, batch, RewardContext(prompts=names)).value, hostile.honest(batch).float()
        )


def test_a_file_that_draws_when_it_is_imported_gives_the_same_in_every_process(cups, tmp_path):
    """Whatever the process drew before it imports the file, which is new to it."""
    file = Path(shutil.copy(FILE, tmp_path / "draws.py"))
    allow_local_rewards(file)
    values = []
    for seed in range(2):
        random.seed(seed)
        torch.manual_seed(seed)
        with IsolatedReward(f"{file}:DrawsWhenMade", seed=5) as reward:
            values.append(evaluate_reward(reward, cups).value)
    assert torch.equal(*values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "error", "message"),
    [("import sys; sys.exit(0)", InvalidInputError, "SystemExit"),
     ("import os; os._exit(0)", RewardError, "ended its process"),
     ("import time; time.sleep(1e6)", RewardError, "took longer than reward_limits.timeout=4 s")],
)  # fmt: skip
def test_a_file_that_exits_or_hangs_when_it_is_imported_is_one_sentence(line, error, message, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(f"{line}\ndef few(batch):\n    return -batch.counts\n")
    allow_local_rewards(path)
    with pytest.raises(error, match=message):
        IsolatedReward(f"{path}:few", timeout=4)


def test_a_reward_that_hangs_is_waited_for_once_by_its_check():
    calls = []

    def slow(batch):
        calls.append(len(batch))
        raise RewardTimeoutError("reward 'slow' took longer than reward_limits.timeout=1 s; its process was ended")

    with pytest.raises(RewardError, match="took longer"):
        check_reward(slow)
    assert len(calls) == 1
