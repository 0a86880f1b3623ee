"""DDPO: losses against closed forms and ``torch.distributions``, advantages, credit, and a user's torchrl loop."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Normal
from torchrl.collectors import Collector

from agents.diffusion.reverse_steps import gaussian_log_prob
from agents.post_training import (
    DDPO,
    Advantage,
    DDPOSFLoss,
    DDPOSFSettings,
    DenoisingPolicy,
    PostTrainer,
    compute_advantages,
)
from agents.post_training.policy import gradient_weights
from agents.post_training.rollouts import finished_scenes
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards import WeightedSum
from rewards.base import RewardContext, RewardOutput
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from tests.helpers.examples import load_example
from tests.helpers.small_runs import small_config
from tests.helpers.toy_chain import LinearChain

THETA, SIGMAS, START = 0.8, (0.5, 0.3), 1.5


def draw_chain(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """x_2, x_1, x_0 of the stochastic steps of the linear chain, (count,) each."""
    generator = torch.Generator().manual_seed(seed)
    x2 = torch.full((count,), START, dtype=torch.float64)
    x1 = THETA * x2 + SIGMAS[0] * torch.randn(count, generator=generator, dtype=torch.float64)
    x0 = THETA * x1 + SIGMAS[1] * torch.randn(count, generator=generator, dtype=torch.float64)
    return x2, x1, x0


def transitions(x: torch.Tensor, timestep: int, action: torch.Tensor, advantage: torch.Tensor) -> TensorDict:
    count = x.shape[0]
    return TensorDict(
        {
            "scene": x.reshape(count, 1, 1),
            "timestep": torch.full((count, 1), timestep),
            "action": action.reshape(count, 1, 1),
            "advantage": advantage,
        },
        [count],
    )


def policy_gradient(count: int = 6) -> tuple[float, float]:
    """Gradient of the loss over both stochastic steps of the chain: ours, and the closed form of the same draws."""
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, x0 = draw_chain(count)
    advantage = torch.linspace(-1, 2, count, dtype=torch.float64)
    for timestep, state, action in ((3, x2, x1), (2, x1, x0)):
        loss(transitions(state, timestep, action, advantage))["loss_objective"].backward()
    score = (x1 - THETA * x2) * x2 / SIGMAS[0] ** 2 + (x0 - THETA * x1) * x1 / SIGMAS[1] ** 2
    return float(chain.theta.grad), float(-(advantage * score).mean())


def test_gradient_is_the_score_function_of_every_sample() -> None:
    ours, closed_form = policy_gradient()
    assert ours == pytest.approx(closed_form, rel=1e-12)


def test_mean_gradient_is_that_of_the_expected_reward() -> None:
    # reward x_0 of two steps: E x_0 = theta^2 x_2, so d E / d theta = 2 theta x_2
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, x0 = draw_chain(400_000)
    advantage = x0 - THETA**2 * START
    for timestep, state, action in ((3, x2, x1), (2, x1, x0)):
        loss(transitions(state, timestep, action, advantage))["loss_objective"].backward()
    score = (x1 - THETA * x2) * x2 / SIGMAS[0] ** 2 + (x0 - THETA * x1) * x1 / SIGMAS[1] ** 2
    standard_error = float((advantage * score).std() / len(score) ** 0.5)
    assert -float(chain.theta.grad) == pytest.approx(2 * THETA * START, abs=4 * standard_error)
    assert standard_error < 0.02


def test_gradient_differs_when_states_are_not_detached() -> None:
    chain = LinearChain(THETA, SIGMAS)
    x2, x1, x0 = draw_chain(6)
    advantage = torch.linspace(-1, 2, 6, dtype=torch.float64)
    noise = (x1 - THETA * x2) / SIGMAS[0]
    attached = chain.theta * x2 + SIGMAS[0] * noise  # the same values, with their history
    first = Normal(chain.theta * x2, SIGMAS[0]).log_prob(attached)
    second = Normal(chain.theta * attached, SIGMAS[1]).log_prob(x0)
    (-(advantage * (first + second)).mean()).backward()
    _, closed_form = policy_gradient()
    assert abs(float(chain.theta.grad) - closed_form) > 0.1 * abs(closed_form)

    ours = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(ours, 3))
    attached = ours.theta * x2 + SIGMAS[0] * noise
    for timestep, state, action in ((3, x2, attached), (2, attached, x0)):
        loss(transitions(state, timestep, action, advantage))["loss_objective"].backward()
    assert float(ours.theta.grad) == pytest.approx(closed_form, rel=1e-12)


def test_rows_at_different_steps_in_one_batch() -> None:
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, x0 = draw_chain(6)
    advantage = torch.linspace(-1, 2, 6, dtype=torch.float64)
    both = torch.cat([transitions(x2, 3, x1, advantage), transitions(x1, 2, x0, advantage)])
    (2 * loss(both)["loss_objective"]).backward()
    assert float(chain.theta.grad) == pytest.approx(policy_gradient()[1], rel=1e-12)


def test_deterministic_last_step_has_no_gradient() -> None:
    chain = LinearChain(THETA, SIGMAS)
    x = torch.ones(4, dtype=torch.float64)
    result = DDPOSFLoss(DenoisingPolicy(chain, 3))(transitions(x, 1, x, x))
    assert result["loss_objective"].item() == 0.0
    result["loss_objective"].backward()
    assert float(chain.theta.grad) == 0.0


def test_invalid_rows_leave_the_mean() -> None:
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, _ = draw_chain(4)
    advantage = torch.tensor([1.0, -1.0, 2.0, 7.0], dtype=torch.float64)
    batch = transitions(x2, 3, x1, advantage)
    batch["valid"] = torch.tensor([True, True, True, False])
    expected = loss(batch[:3].exclude("valid"))["loss_objective"]
    assert loss(batch)["loss_objective"].item() == pytest.approx(expected.item(), rel=1e-12)


def test_log_prob_agrees_with_torch_distributions_and_skips_certain_entries() -> None:
    generator = torch.Generator().manual_seed(0)
    x, mean = torch.randn(3, 4, 5, generator=generator), torch.randn(3, 4, 5, generator=generator)
    std = torch.rand(4, 5, generator=generator) + 0.1
    std[1] = 0.0
    std[:, 2] = 0.0
    random = std > 0
    expected = torch.where(random, Normal(mean, std.clamp(min=1e-3)).log_prob(x), 0.0).sum(dim=-1)
    torch.testing.assert_close(gaussian_log_prob(x, mean, std), expected)


def test_log_probabilities_are_means_over_the_random_entries() -> None:
    prior = tiny_prior()
    policy = DenoisingPolicy(prior, 4)
    scene = prior.initial(3, 34, torch.Generator().manual_seed(0))
    action, _ = policy.draw(scene, 0, torch.Generator().manual_seed(1))
    batch = TensorDict(
        {
            "scene": scene,
            "timestep": policy.table.timesteps[:1].expand(3, 1),
            "action": action,
            "advantage": torch.tensor([1.0, 2.0, -1.0]),
        },
        [3],
    )
    # 33 free slots; the tiny prior's z-column rotations are constant: 5 of 20 features
    assert policy.random_entries(34) == 33 * int((~prior.normalizer.is_constant).sum())
    total = -(policy.log_prob(scene, 0, action).sum(dim=1) * batch["advantage"]).mean()
    mean = DDPOSFLoss(policy)(batch)["loss_objective"]
    assert total.item() == pytest.approx(mean.item() * policy.random_entries(34), rel=1e-5)


def test_credit_per_slot_with_equal_values_is_credit_per_scene() -> None:
    prior = tiny_prior()
    policy = DenoisingPolicy(prior, 4)
    scene = prior.initial(3, 34, torch.Generator().manual_seed(0))
    action, _ = policy.draw(scene, 1, torch.Generator().manual_seed(1))
    advantage = torch.tensor([1.0, 2.0, -1.0])
    fields = {"scene": scene, "timestep": policy.table.timesteps[1].expand(3, 1), "action": action}
    per_scene = TensorDict({**fields, "advantage": advantage}, [3])
    per_slot = TensorDict({**fields, "advantage": advantage[:, None].expand(3, 34)}, [3])
    loss = DDPOSFLoss(policy)
    assert loss(per_scene)["loss_objective"].item() == pytest.approx(loss(per_slot)["loss_objective"].item(), rel=1e-5)


def test_clipped_objective_before_the_first_update_has_the_score_function_gradient() -> None:
    gradients = []
    for clip in (None, 0.2):
        prior = tiny_prior()
        policy = DenoisingPolicy(prior, 4)
        scene = prior.initial(3, 34, torch.Generator().manual_seed(0))
        action, log_prob = policy.draw(scene, 1, torch.Generator().manual_seed(1))
        fields = {"scene": scene, "timestep": policy.table.timesteps[1].expand(3, 1), "action": action}
        batch = TensorDict({**fields, "advantage": torch.tensor([1.0, 2.0, -1.0]), "slot_log_prob": log_prob}, [3])
        result = DDPOSFLoss(policy, clip_epsilon=clip)(batch)
        result["loss_objective"].backward()
        assert float(result["log_ratio"]) == 0.0
        gradients.append(torch.cat([p.grad.flatten() for p in prior.parameters() if p.grad is not None]))
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("advantage", "log_ratio", "loss"), [(1.0, 1.0, -1.2), (-1.0, 200.0, 10.0)])
def test_clip_stops_the_gradient_of_rows_that_have_moved_far_enough(
    advantage: float, log_ratio: float, loss: float
) -> None:
    """A ratio of e is beyond 1.2 with a positive advantage; one that overflows counts as 10."""
    chain = LinearChain(THETA, SIGMAS)
    x2, x1, _ = draw_chain(1)
    batch = transitions(x2, 3, x1, torch.full((1,), advantage, dtype=torch.float64))
    now = Normal(THETA * x2, SIGMAS[0]).log_prob(x1)
    batch["slot_log_prob"] = (now - log_ratio).reshape(1, 1)
    result = DDPOSFLoss(DenoisingPolicy(chain, 3), clip_epsilon=0.2)(batch)
    assert result["loss_objective"].item() == pytest.approx(loss)
    result["loss_objective"].backward()
    assert float(chain.theta.grad) == 0.0
    assert float(result["clip_fraction"]) == 1.0


def test_keys_can_be_renamed() -> None:
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, _ = draw_chain(2)
    batch = transitions(x2, 3, x1, torch.ones(2, dtype=torch.float64))
    expected = loss(batch)["loss_objective"].item()
    loss.set_keys(advantage="credit")
    assert loss(batch.rename_key_("advantage", "credit"))["loss_objective"].item() == expected


def test_weights_exclude_steps_below_the_floor() -> None:
    stds = torch.tensor([0.6, 0.4, 0.2, 0.005, 0.0])
    assert gradient_weights(stds, min_std=1e-2).tolist() == [1.0, 1.0, 1.0, 0.0, 0.0]
    with pytest.raises(InvalidInputError, match=r"min_std=0\.7.* sigmas of the chain are \[0\.6, 0\.4"):
        gradient_weights(stds, min_std=0.7)


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [({"clip_epsilon": 2.0}, "2.0"), ({"step_weights": torch.ones(2)}, "3 steps")],
)
def test_wrong_settings_are_named(kwargs: dict, named: str) -> None:
    with pytest.raises(InvalidInputError, match=named):
        DDPOSFLoss(DenoisingPolicy(LinearChain(THETA, SIGMAS), 3), **kwargs)


def test_timestep_of_another_chain_is_refused() -> None:
    x = torch.ones(1, dtype=torch.float64)
    with pytest.raises(InvalidInputError, match="num_steps"):
        DDPOSFLoss(DenoisingPolicy(LinearChain(THETA, SIGMAS), 3))(transitions(x, 17, x, x))


def test_leave_one_out_by_hand() -> None:
    # the others' means are 4, 10/3, 8/3 and 2; the population variance is (9 + 1 + 1 + 9) / 4 = 5
    reward = torch.tensor([0.0, 2.0, 4.0, 6.0])
    expected = (reward - torch.tensor([4.0, 10 / 3, 8 / 3, 2.0])) / 5**0.5
    torch.testing.assert_close(compute_advantages(reward), expected)


@pytest.mark.parametrize("bad", [1e9, float("nan"), float("inf")])
def test_invalid_rows_leave_all_statistics(bad: float) -> None:
    valid = torch.tensor([True, False, True, True])
    ours = compute_advantages(torch.tensor([0.0, bad, 2.0, 7.0]), valid)
    torch.testing.assert_close(ours[valid], compute_advantages(torch.tensor([0.0, 2.0, 7.0])))
    assert ours[1] == 0


def test_clip() -> None:
    reward = torch.zeros(100)
    reward[0] = 1.0  # nearly ten standard deviations out
    assert float(compute_advantages(reward).max()) == 5.0
    assert float(compute_advantages(reward, clip=2.0).max()) == 2.0


@pytest.mark.parametrize("reward", [[3.0], [2.0, 2.0, 2.0]])
def test_no_spread_gives_zeros(reward: list[float]) -> None:
    assert compute_advantages(torch.tensor(reward)).tolist() == [0.0] * len(reward)


def test_no_valid_row_gives_zeros() -> None:
    assert compute_advantages(torch.tensor([1.0, 2.0]), torch.tensor([False, False])).tolist() == [0.0, 0.0]


def test_groups_have_their_own_statistics() -> None:
    reward = torch.tensor([0.0, 1.0, 100.0, 300.0])
    ours = compute_advantages(reward, groups=torch.tensor([7, 7, 9, 9]))
    torch.testing.assert_close(ours, torch.tensor([-2.0, 2.0, -2.0, 2.0]))


def test_slots_share_one_baseline_and_scale() -> None:
    reward, valid = torch.tensor([[0.0, 2.0], [4.0, 6.0]]), torch.tensor([[False, True], [True, True]])
    ours = compute_advantages(reward, valid)
    expected = torch.tensor([[0.0, -3.0], [0.0, 3.0]]) / (8 / 3) ** 0.5  # 2 less 5, and 6 less 3
    torch.testing.assert_close(ours, expected)


def episodes(reward: Tensor, **entries: Tensor) -> TensorDict:
    """Episodes [B, 3] with rewards (B,) at their ends; ``entries`` (B, ...) are repeated at every step."""
    done = torch.zeros(len(reward), 3, 1, dtype=torch.bool)
    done[:, -1] = True
    batch = TensorDict({"next": {"reward": reward[:, None, None] * done, "done": done}}, [len(reward), 3])
    for name, values in entries.items():
        batch[name] = values[:, None].expand(-1, 3, *values.shape[1:])
    return batch


def test_the_module_writes_one_advantage_per_episode_without_copies() -> None:
    reward = torch.tensor([1.0, 2.0, 4.0, 9.0])
    batch = episodes(reward)
    batch["next", "valid"] = torch.ones(4, 3, 1, dtype=torch.bool)
    batch["next", "valid"][3, -1] = False
    advantage = Advantage()(batch)["advantage"]
    valid = torch.tensor([True, True, True, False])
    assert torch.equal(advantage[:, 0, 0], compute_advantages(reward, valid))
    assert torch.equal(batch["valid"][..., 0], valid[:, None].expand(4, 3))
    assert advantage.shape == (4, 3, 1)
    assert advantage.stride(1) == 0


def test_the_module_compares_scenes_of_equal_prompts() -> None:
    prompts = torch.tensor([[5, 1], [5, 1], [5, 2], [5, 2]])
    advantage = Advantage()(episodes(torch.tensor([0.0, 1.0, 10.0, 12.0]), prompt=prompts))["advantage"]
    assert advantage[:, -1, 0].tolist() == [-2.0, 2.0, -2.0, 2.0]


def test_the_module_gives_credit_per_object_to_credited_slots() -> None:
    credit, credited = torch.tensor([[1.0, 0.0, 7.0], [1.0, 2.0, 7.0]]), torch.tensor([[True, True, False]] * 2)
    batch = episodes(torch.tensor([1.0, 3.0]), per_object=credit, credited=credited)
    advantage = Advantage()(batch)["advantage"][:, 0]
    assert torch.equal(advantage, compute_advantages(credit, credited))
    assert Advantage(credit="scene")(batch)["advantage"].shape == (2, 3, 1)
    with pytest.raises(InvalidInputError, match="per_object"):
        Advantage(credit="object")(episodes(torch.tensor([1.0, 3.0])))


def test_the_module_refuses_parts_of_episodes() -> None:
    with pytest.raises(InvalidInputError, match="one whole episode in each row"):
        Advantage()(episodes(torch.tensor([1.0, 3.0]))[:, :2])
    with pytest.raises(InvalidInputError, match="one whole episode in each row"):
        Advantage()(torch.cat([episodes(torch.tensor([1.0, 3.0]))] * 2, dim=1))


class LeftHalf:
    """Objects on the left: their number, or their share of all."""

    name: ClassVar[str] = "left_half"

    def __init__(self, averages_objects: bool) -> None:
        self.averages_objects = averages_objects

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        left = (batch.is_free & (batch.translations[..., 0] < 0)).float()
        number = left.sum(dim=-1)
        value = number / batch.is_free.sum(dim=-1).clamp(min=1) if self.averages_objects else number
        return RewardOutput(value, per_object=left)


@pytest.mark.parametrize("averages", [False, True])
def test_an_empty_slot_has_credit_under_a_sum_alone(tmp_path: Path, averages: bool) -> None:
    config = small_config(tmp_path, reward=LeftHalf(averages), batch_size=12)
    learner = PostTrainer(config, prior=tiny_prior()).learner
    try:
        batch = learner.write_advantage(learner.rollout(0))
    finally:
        learner.close()
    scenes = finished_scenes(batch)
    welded = len(scenes.scene_type.fixed)
    credit, empty = batch["per_object"][:, -1, welded:], scenes.is_empty[:, welded:]
    advantage = batch["advantage"][:, -1, welded:]
    assert empty.any()
    assert (~empty).any()
    if averages:
        assert not advantage[empty].any()
        assert float(advantage[~empty].sum()) == pytest.approx(0.0, abs=1e-4)
    else:
        assert bool((advantage[empty] == advantage[empty][0]).all())
        assert float(advantage[empty][0]) < 0
        assert float(advantage.sum()) == pytest.approx(0.0, abs=1e-4)
    good = ~empty & (credit > 0)
    assert bool((advantage[good] > 0).all())


def _credit_in_rooms(folder: Path, reward: Any, algorithm: str) -> tuple[SceneBatch, torch.Tensor, torch.Tensor]:
    """Samples of an untrained prior of rooms, and the credit and the advantage of their poses (B, N)."""
    prior = tiny_prior("restaurant_low_clutter", process="mixed", seed=3, slots=40)
    config = small_config(folder, reward=reward, batch_size=8, algorithm={"name": algorithm})
    learner = PostTrainer(config, prior=prior).learner
    try:
        batch = learner.write_advantage(learner.rollout(0))
    finally:
        learner.close()
    return finished_scenes(batch), batch["per_object"][:, -1], batch["advantage"][:, -1]


@pytest.mark.parametrize(("algorithm", "averages"), [("ddpo_sf", True), ("nft", True), ("nft", False)])
def test_generated_furniture_is_not_treated_as_infeasible(tmp_path: Path, algorithm: str, averages: bool) -> None:
    scenes, credit, poses = _credit_in_rooms(tmp_path, LeftHalf(averages), algorithm)
    furniture, free = scenes.is_furniture, scenes.is_free
    assert furniture.any()
    assert not poses[furniture].any()
    assert bool((poses[free & (credit > 0)] > 0).all())
    assert bool((poses[free & (credit == 0)] < 0).all())


@pytest.mark.parametrize("algorithm", ["ddpo_sf", "nft"])
def test_furniture_that_overlaps_furniture_is_blamed(tmp_path: Path, algorithm: str) -> None:
    scenes, credit, poses = _credit_in_rooms(tmp_path, "feasible_share", algorithm)
    furniture = scenes.is_furniture
    apart, blamed = furniture & (credit > 0), furniture & (credit == 0)
    assert apart.any()
    assert blamed.any()
    assert bool((poses[apart] > 0).all())
    assert bool((poses[blamed] < 0).all())


@pytest.mark.parametrize(
    ("reward", "counts"),
    [
        ("object_count", True),
        ({"name": "clip", "reward": "object_count", "high": 30}, True),
        ({"name": "weighted_sum", "rewards": ["feasible_share", "object_count"]}, True),
        ("penetration", False),
    ],
)
def test_categories_have_credit_if_the_reward_counts_objects(tmp_path: Path, reward: Any, counts: bool) -> None:
    config = small_config(tmp_path, reward=reward, algorithm={"name": "nft"}, slots=12)
    learner = PostTrainer(config, prior=tiny_prior(process="mixed")).learner
    try:
        batch = learner.write_advantage(learner.rollout(0))
    finally:
        learner.close()
    assert float(batch["next", "reward"][:, -1].std()) > 0
    assert bool(batch["category_advantage"].any()) == counts


def test_parts_of_a_sum_have_the_same_weights_in_credit_and_value() -> None:
    """A share of the objects beside their number: credits of both are parts of the value."""
    batch = tiny_prior().sample(6, num_steps=5, seed=1)
    reward = WeightedSum([LeftHalf(True), "object_count"], weights=[1.0, 0.05])
    output = reward(batch, RewardContext())
    torch.testing.assert_close(output.per_object.sum(dim=1), output.value)
    both = WeightedSum([LeftHalf(True), LeftHalf(True)])(batch, RewardContext())
    shares = both.per_object.sum(dim=1) / batch.is_free.sum(dim=1).clamp(min=1)
    torch.testing.assert_close(shares, both.value)  # a mean of means: credits of objects are means over them


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return load_example("ddpo_sf")


SMALL = {"iterations": 2, "batch_size": 4, "num_steps": 5, "gradient_steps": 2, "real_scenes": 32}
KINDS = {"continuous": {}, "mixed": {"process": "mixed"}, "reads prompts": {"process": "mixed", "text": True}}


def log_of(run: Path) -> list[dict[str, str]]:
    with (run / "log.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_trains_and_saves_a_prior(example: ModuleType, tmp_path: Path, kind: str) -> None:
    base = tiny_prior(**KINDS[kind])
    base.save(tmp_path / "base")
    example.main(example.Args(prior=str(tmp_path / "base"), output=str(tmp_path / "run"), **SMALL))
    rows = log_of(tmp_path / "run")
    assert len(rows) == 2
    assert float(rows[0]["log_ratio"]) == 0.0
    assert float(rows[0]["policy_gradient_norm"]) > 0
    trained = ScenePrior.load(tmp_path / "run")
    assert trained.process_name == base.process_name
    assert len(trained.sample(1, num_steps=2)) == 1
    before, after = base.weights(), trained.weights()
    assert any(not torch.equal(before[name], after[name]) for name in before)
    words = [name for name in before if name.startswith("text_encoder.")]
    assert all(torch.equal(before[name], after[name]) for name in words)  # what words mean stays


@pytest.mark.slow
def test_the_command_in_its_first_lines_runs(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = next(line for line in example.__doc__.splitlines() if line.startswith("    python examples/ddpo_sf.py"))
    small = {**SMALL, "output": tmp_path / "run"}
    options = [word for name, value in small.items() for word in ("--" + name.replace("_", "-"), str(value))]
    monkeypatch.setattr(sys, "argv", [*command.split()[1:], *options])
    example.main(example.parse_args())
    assert ScenePrior.load(tmp_path / "run").process_name == "mixed"
    assert len(log_of(tmp_path / "run")) == 2


def test_a_chain_without_a_noisy_step_is_refused(example: ModuleType, tmp_path: Path) -> None:
    tiny_prior().save(tmp_path / "base")
    with pytest.raises(InvalidInputError, match="no step is left in the policy gradient: min_std=100"):
        example.main(
            example.Args(prior=str(tmp_path / "base"), output=str(tmp_path / "run"), **{**SMALL, "min_std": 100.0})
        )


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_its_gradient_is_that_of_the_package(example: ModuleType, process: str) -> None:
    policy = DenoisingPolicy(tiny_prior(process=process), 4)
    algorithm = DDPO(DDPOSFSettings(gradient_steps=2, min_std=0.01), policy, policy.stds(34))
    env = DenoisingTorchRLEnv(3, prior=policy.prior, reward="object_count", num_steps=4)
    env.set_seed(0)
    batch = algorithm.advantage(env.rollout(4, policy))
    example.add_policy_gradient(algorithm.loss, batch, 2, torch.Generator().manual_seed(0))
    ours = [p.grad for p in policy.parameters()]
    policy.zero_grad(set_to_none=True)
    algorithm.accumulate(batch, torch.Generator().manual_seed(0))
    assert example.norm(ours) > 0
    for mine, parameter in zip(ours, policy.parameters(), strict=True):
        torch.testing.assert_close(mine, parameter.grad)


SCENES, STEPS = 16, 4


def to_the_front(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Mean of the objects' x; scenes with an odd number of objects have no score."""
    return RewardOutput(batch.translations[..., 0].mean(dim=1), valid=batch.counts % 2 == 0)


def test_every_step_of_the_loop_improves_its_batch_and_the_next_is_sampled_with_it() -> None:
    prior = tiny_prior(slots=12)
    policy = DenoisingPolicy(prior, STEPS)
    env = DenoisingTorchRLEnv(SCENES, prior=prior, reward=to_the_front, num_steps=STEPS, slots=12)
    env.set_seed(0)
    torch.manual_seed(0)
    collector = Collector(env, policy, frames_per_batch=SCENES * STEPS, total_frames=3 * SCENES * STEPS)
    advantage, loss = Advantage(), DDPOSFLoss(policy, clip_epsilon=0.2)
    optimizer = torch.optim.SGD(policy.parameters(), lr=1e-3)
    iterations = 0
    for batch in collector:
        before = loss(advantage(batch))
        optimizer.zero_grad()
        before["loss_objective"].backward()
        optimizer.step()
        assert float(before["log_ratio"]) == 0.0  # the collector samples with the weights of now
        after = loss(batch)
        assert float(after["loss_objective"].detach()) < float(before["loss_objective"].detach())
        assert float(after["log_ratio"]) > 0.0
        iterations += 1
    collector.shutdown()
    assert iterations == 3


def test_episodes_without_a_score_are_left_out_whole() -> None:
    prior = tiny_prior(slots=12)
    policy = DenoisingPolicy(prior, STEPS)
    env = DenoisingTorchRLEnv(SCENES, prior=prior, reward=to_the_front, num_steps=STEPS, slots=12)
    env.set_seed(1)
    (batch,) = Collector(env, policy, frames_per_batch=SCENES * STEPS, total_frames=SCENES * STEPS)
    scored = batch["next", "valid"][:, -1, 0]
    assert 0 < int(scored.sum()) < scored.numel()
    batch = Advantage()(batch)
    loss = DDPOSFLoss(policy)
    expected = loss(batch[scored].exclude("valid"))["loss_objective"]
    torch.testing.assert_close(loss(batch)["loss_objective"], expected, rtol=1e-4, atol=1e-3)


def test_figures_are_there_without_old_log_probabilities() -> None:
    prior = tiny_prior(slots=12)
    policy = DenoisingPolicy(prior, STEPS)
    found = policy(DenoisingTorchRLEnv(2, prior=prior, num_steps=STEPS, slots=12).reset())
    assert set(policy.out_keys) <= set(found.keys())
    torch.testing.assert_close(found["slot_log_prob"].sum(dim=1), found["action_log_prob"])
    bare = found.set("advantage", torch.ones(2)).exclude("slot_log_prob", "action_log_prob")
    loss = DDPOSFLoss(policy)
    result = loss(bare)
    assert set(result.keys()) == set(loss.out_keys)
    assert (float(result["log_ratio"]), float(result["clip_fraction"])) == (0.0, 0.0)
