#!/usr/bin/env bash
# One would guess: with batches of whole episodes, seeding the environment between two batches of a torchrl Collector
# decides the first state of the next episode, as it does before env.rollout. So a run that is resumed from the number
# of a batch alone equals the uninterrupted one.
# What happens: the Collector resets a finished environment while it still belongs to the batch before. The next batch
# starts from a state that was drawn before set_seed was called. The seed takes effect one episode later. With
# reset_at_each_iter=True the seed decides.
# Whom it hurts: who seeds each batch for exact resume, or to give every process of a run its own episodes.
# Seen (torchrl 0.14.1, torch 2.13.0):
#   env.rollout, seeded before each:    [0.4963, 0.7576, 0.6147]
#   Collector, seeded between batches:  [0.4963, 0.7682, 0.7576]
#   Collector, reset_at_each_iter=True: [0.7682, 0.7576, 0.6147]
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/venv"
"$dir/venv/bin/pip" install -q torch==2.13.0 torchrl==0.14.1 tensordict==0.14.3 numpy==2.4.6
"$dir/venv/bin/python" - <<'PYTHON'
import warnings

warnings.filterwarnings("ignore")
import torch
import torchrl
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

STEPS = 3


class Counter(EnvBase):
    """Episodes of three steps, whose first state is drawn by the seeded generator."""

    def __init__(self):
        super().__init__(batch_size=[])
        self.observation_spec = Composite(state=Unbounded(1))
        self.action_spec = Unbounded(1)
        self.reward_spec = Unbounded(1)
        self.rng = torch.Generator()

    def _set_seed(self, seed):
        self.rng.manual_seed(seed)

    def _reset(self, tensordict=None):
        self.count = 0
        return TensorDict({"state": torch.rand(1, generator=self.rng)}, [])

    def _step(self, tensordict):
        self.count += 1
        return TensorDict(
            {"state": tensordict["state"], "reward": torch.zeros(1), "done": torch.tensor([self.count == STEPS])}, []
        )


def first_states(**options):
    """First states of three batches of one episode; the environment is seeded with the next number after each batch."""
    env, found = Counter(), []
    env.set_seed(0)
    collector = Collector(
        env, lambda td: td.set("action", torch.zeros(1)), frames_per_batch=STEPS, total_frames=3 * STEPS, **options
    )
    for number, batch in enumerate(collector):
        found.append(round(float(batch["state"][0]), 4))
        env.set_seed(number + 1)
    return found


def rollouts():
    env, found = Counter(), []
    for number in range(3):
        env.set_seed(number)
        found.append(round(float(env.rollout(STEPS)["state"][0]), 4))
    return found


print("torchrl", torchrl.__version__, "torch", torch.__version__)
seeded, usual, each = rollouts(), first_states(), first_states(reset_at_each_iter=True)
print("env.rollout, seeded before each:   ", seeded)
print("Collector, seeded between batches: ", usual)
print("Collector, reset_at_each_iter=True:", each)
raise SystemExit(0 if usual != seeded and each[1:] == seeded[1:] else 1)
PYTHON
