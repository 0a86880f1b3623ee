"""Masks of the search: the objects they regenerate, on scenes whose overlaps are known."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from agents.planning.search_run import SearchConfig
from agents.priors.testing import tiny_prior
from rewards import RewardOutput
from scene_envs.envs import SearchProblem, register_mask
from scene_envs.envs.masks import (
    BalancedMask,
    CulpritsMask,
    EmptyMask,
    MaskGenerator,
    OffPromptMask,
    blamed_or_empty_mask,
    cover,
    infeasible_mask,
    infeasible_or_empty_mask,
    list_masks,
    mask_for_prompt,
    resolve_mask,
)
from scene_envs.envs.scoring import RewardScorer, Score
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.scene import SceneBatch
from tests.helpers.toy_prior import ToyPrior

ID = "scene_envs:SceneEnvs/Search-v0"


def table_with(*objects: tuple[str, float, float, float]) -> SceneBatch:
    """One dimsum scene: the table, then (asset, x, y, z) in the given order."""
    batch = SceneBatch.empty("dimsum_table", 1)
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories
    for slot, (name, *position) in enumerate(objects, start=1):
        translations[0, slot] = torch.tensor(position)
        rotations[0, slot] = torch.eye(3)
        categories[0, slot] = batch.scene_type.assets.index(name)
    return SceneBatch.from_parts(translations, rotations, categories, batch.scene_type)


def feasible_score(scene: SceneBatch) -> Score:
    return RewardScorer("feasible_objects")(scene)


def masked(scene: SceneBatch, mask: MaskGenerator, seed: int = 0) -> tuple[list[int], int]:
    """Masked objects, and how many empty slots are masked with them."""
    chosen = mask(scene, feasible_score(scene), np.random.default_rng(seed))
    empty = scene.is_empty[0]
    return torch.nonzero(chosen & ~empty).flatten().tolist(), int((chosen & empty).sum())


def test_one_object_in_the_way_of_two_is_the_only_one_replaced() -> None:
    scene = table_with(("teapot", 0, 0, 0), ("dinner_plate", 0.15, 0, 0), ("dinner_plate", -0.15, 0, 0))
    assert masked(scene, infeasible_mask) == ([1, 2, 3], 0)
    assert masked(scene, infeasible_or_empty_mask) == ([1, 2, 3], 30)
    assert masked(scene, CulpritsMask(at_least=1)) == ([1], 0)


def test_of_two_that_overlap_one_is_replaced_and_chance_says_which() -> None:
    scene = table_with(("dinner_plate", 0, 0, 0), ("dinner_plate", 0.2, 0, 0), ("teacup", -0.3, 0, 0))
    chosen = [masked(scene, CulpritsMask(at_least=1), seed) for seed in range(12)]
    assert {tuple(slots) for slots, _ in chosen} == {(1,), (2,)}
    assert chosen[0] == masked(scene, CulpritsMask(at_least=1))


def test_objects_that_fall_or_sink_into_the_table_are_replaced() -> None:
    scene = table_with(("teacup", 0.2, 0, 0.05), ("teapot", -0.2, 0, -0.01), ("teacup", 0, 0.2, 0))
    assert masked(scene, CulpritsMask(at_least=2)) == ([1, 2], 0)
    assert masked(scene, infeasible_mask) == ([1, 2], 0)
    assert masked(scene, CulpritsMask(at_least=5)) == ([1, 2], 3)


def test_a_perfect_scene_grows_in_a_few_empty_slots() -> None:
    scene = table_with(("teacup", 0.2, 0, 0), ("teapot", -0.2, 0, 0))
    assert masked(scene, CulpritsMask()) == ([], 4)


def test_a_full_perfect_scene_still_has_something_to_try() -> None:
    scene = table_with(("teacup", 0.2, 0, 0), ("teapot", -0.2, 0, 0)).with_slots(4)
    slots, empties = masked(scene, CulpritsMask(at_least=2))
    assert (len(slots), empties) == (1, 1)


def test_a_bare_table_is_regenerated_whole() -> None:
    assert masked(SceneBatch.empty("dimsum_table", 1), CulpritsMask()) == ([], 33)


def test_an_objective_that_blames_nobody_by_name_gets_random_slots() -> None:
    scene = table_with(*(("teacup", 0.1 * k, 0, 0) for k in range(-3, 4)))
    score = RewardScorer(lambda batch, context: RewardOutput(batch.counts.float()))(scene)
    masks = [CulpritsMask(at_least=3)(scene, score, np.random.default_rng(seed)) for seed in range(30)]
    assert {int(mask.sum()) for mask in masks} == {3}
    reached = torch.stack(masks).any(dim=0)
    assert not bool(reached[0])  # the table
    assert int(reached.sum()) > 25


def test_a_balanced_mask_has_the_same_share_of_objects_and_empty_slots() -> None:
    batch = table_with(*(("teacup", 0.0, 0.0, 5.0 + k) for k in range(10)))  # in the air, far apart
    bad = torch.zeros(1, 34, dtype=torch.bool)
    bad[0, 1:5] = True
    score = Score(torch.zeros(1), torch.ones(1, dtype=torch.bool), {}, None, {"feasible": ~bad})
    for seed in range(3):
        mask = BalancedMask()(batch, score, np.random.default_rng(seed))
        assert torch.equal(mask & batch.is_free[0], bad[0])  # 4 of 10 objects
        assert int((mask & batch.is_empty[0]).sum()) == 9  # and of 23 empty slots
    good = Score(torch.zeros(1), torch.ones(1, dtype=torch.bool), {}, None, {"feasible": torch.ones_like(bad)})
    mask = BalancedMask(at_least=6)(batch, good, np.random.default_rng(0))
    assert (int((mask & batch.is_free[0]).sum()), int((mask & batch.is_empty[0]).sum())) == (2, 4)  # 6 of 33


def test_covers_touch_every_pair_and_spare_the_fixed() -> None:
    for seed in range(50):
        rng = np.random.default_rng(seed)
        pairs = [pair for pair in itertools.combinations(range(9), 2) if rng.random() < 0.3 and pair != (0, 1)]
        chosen = cover(pairs, {0, 1}, rng)
        assert all(set(pair) & set(chosen) for pair in pairs)
        assert not {0, 1} & set(chosen)
        assert len(chosen) < 7 or not pairs or all(any(s in p for p in pairs) for s in chosen)


def test_feasibility_is_asked_of_physics_where_the_objective_says_nothing_of_it() -> None:
    scene = table_with(("teacup", 0.2, 0, 0.05), ("teapot", -0.2, 0, 0))
    silent = RewardScorer("object_count")(scene)
    assert infeasible_mask(scene, silent, np.random.default_rng(0)).nonzero().flatten().tolist() == [1]


def test_one_simulation_serves_the_mask_and_the_objective(monkeypatch: pytest.MonkeyPatch) -> None:
    from rewards.feasible import forget_verdicts
    from scene_envs import physics

    calls: list[int] = []
    judge = physics.feasibility
    monkeypatch.setattr(
        "scene_envs.physics.feasibility", lambda batch, **limits: calls.append(len(batch)) or judge(batch, **limits)
    )
    forget_verdicts()
    scene = table_with(("teacup", 0.2, 0, 0.05))
    score = RewardScorer("feasible_share")(scene)
    infeasible_mask(scene, score, np.random.default_rng(0))
    infeasible_mask(scene, RewardScorer("object_count")(scene), np.random.default_rng(0))
    assert calls == [1]


def test_masks_with_settings() -> None:
    scene = table_with(("teacup", 0.2, 0, 0), ("teapot", -0.2, 0, 0), ("dinner_plate", 0, 0.3, 0))
    assert masked(scene, EmptyMask()) == ([], 30)
    assert masked(scene, EmptyMask(count=3)) == ([], 3)
    with pytest.raises(UnknownNameError, match="did you mean 'count'"):
        resolve_mask({"name": "empty", "cuont": 3})


def test_what_the_prompt_does_not_ask_for_is_off_prompt() -> None:
    scene = table_with(("teacup", 0.2, 0, 0), ("teacup", -0.2, 0, 0), ("teacup", 0, 0.3, 0), ("teapot", 0, -0.3, 0))
    two_cups = OffPromptMask("A scene with two cups.")
    objects, empty = masked(scene, two_cups)
    assert len(objects) == 1
    assert objects[0] in (1, 2, 3)
    assert empty == 0
    assert masked(scene, OffPromptMask("A scene with five cups.")) == ([], 2)
    assert masked(scene, OffPromptMask("A scene with three cups.")) == ([], 0)
    with pytest.raises(InvalidInputError, match="no prompt"):
        masked(scene, OffPromptMask())


@dataclass(frozen=True)
class FirstWordMask:
    """A mask of somebody else's that reads the prompt: as many slots as its first word has letters."""

    letters: int = 0

    def for_prompt(self, prompt: str | None) -> FirstWordMask:
        return FirstWordMask(len((prompt or "").split(" ")[0]))

    def __call__(self, scene: SceneBatch, score: Score, rng: np.random.Generator) -> torch.Tensor:
        return torch.arange(scene.tensor.shape[1]) < 3 + self.letters


def test_a_mask_that_reads_the_prompt_gets_that_of_the_search() -> None:
    prior = tiny_prior("dimsum_table", process="mixed", text=True)
    problem = SearchProblem(
        prior=prior, objective="object_count", num_steps=2, prompt="Three cups.", mask=FirstWordMask(), max_depth=1
    )
    assert int(problem.root(seed=0).mask.sum()) == 3 + len("Three") - len(problem.scene_type.fixed)
    own = mask_for_prompt(OffPromptMask("A scene with two cups."), "A scene with five cups.")
    assert own == OffPromptMask("A scene with two cups.")


def test_the_default_mask_has_what_the_objective_blames_and_all_empty_slots() -> None:
    scene = table_with(("teapot", 0, 0, 0), ("dinner_plate", 0.02, 0, 0), ("teacup", -0.3, 0, 0))
    assert masked(scene, blamed_or_empty_mask) == masked(scene, infeasible_or_empty_mask) == ([1, 2], 30)
    credit = Score(torch.zeros(1), torch.ones(1, dtype=torch.bool), per_object=torch.arange(34.0)[None] - 1)
    assert blamed_or_empty_mask(scene, credit, np.random.default_rng(0)).nonzero().flatten().tolist() == [
        1,
        *range(4, 34),
    ]
    silent = Score(torch.zeros(1), torch.ones(1, dtype=torch.bool))
    assert int(blamed_or_empty_mask(scene, silent, np.random.default_rng(0)).sum()) == 2 + 30  # half of the objects
    full = SceneBatch(scene.tensor[:, :4], scene.scene_type)
    praised = Score(torch.zeros(1), torch.ones(1, dtype=torch.bool), per_object=torch.ones(1, 4))
    assert int(blamed_or_empty_mask(full, praised, np.random.default_rng(0)).sum()) == 2


def test_names_are_resolved_and_unknown_ones_get_an_offer() -> None:
    assert resolve_mask("culprits") == CulpritsMask()
    assert resolve_mask("infeasible") is infeasible_mask
    with pytest.raises(UnknownNameError, match="did you mean 'culprits'"):
        resolve_mask("culprit")
    with pytest.raises(InvalidInputError, match="balanced, blamed_or_empty, culprits, empty, infeasible"):
        resolve_mask(3)


def test_a_registered_mask_works_by_name_in_the_environment(prior: ToyPrior, free_objects: Any) -> None:
    @register_mask("odd_slots")
    def odd_slots(scene: SceneBatch, score: Score, rng: np.random.Generator) -> torch.Tensor:
        return torch.arange(scene.tensor.shape[1]) % 2 == 1

    env = gym.make(ID, prior=prior, objective=free_objects, num_steps=1, mask="odd_slots").unwrapped
    observation, _ = env.reset(seed=0)
    welded = env.scene().is_welded[0].numpy()
    assert observation["regenerate"].tolist() == ((np.arange(34) % 2 == 1) & ~welded).tolist()
    with pytest.raises(InvalidInputError, match="mask generator name"):
        register_mask("odd slots")


def test_a_mask_of_an_installed_package_works_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("everything", "torch:ones_like", "scene_envs.masks")
    monkeypatch.setattr("scene_envs.registry.plugin_entry_points", lambda group: {"everything": point})
    assert "everything" in list_masks()
    assert resolve_mask("everything") is torch.ones_like


def test_the_environment_and_the_search_run_have_one_default(prior: ToyPrior, free_objects: Any) -> None:
    env = gym.make(ID, prior=prior, objective=free_objects, num_steps=1).unwrapped
    assert env.problem.mask_generators == [resolve_mask(SearchConfig().mask)] == [blamed_or_empty_mask]


def fails(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Any:
    raise ValueError("no such shelf")


@pytest.mark.parametrize(
    ("generator", "said"),
    [
        (fails, r"mask 'fails' raised ValueError: no such shelf \(.*test_masks.py, line \d+\)"),
        (lambda scene: None, r"raised TypeError: .*takes 1 positional argument.*\(scene, score, rng\)"),
        (lambda scene, score, rng: None, r"returned NoneType; return a bool tensor of shape \(34,\)"),
        (lambda scene, score, rng: [True] * 34, "returned list"),
        (lambda scene, score, rng: scene.is_empty, r"returned torch.bool of shape \(1, 34\)"),
        (lambda scene, score, rng: scene.is_empty[0].float(), r"returned torch.float32 of shape \(34,\)"),
    ],
)
def test_a_mask_that_breaks_its_contract_is_told_so(generator: Any, said: str, free_objects: Any) -> None:
    problem = SearchProblem(prior=tiny_prior(), objective=free_objects, mask=generator, num_steps=2)
    with pytest.raises(InvalidInputError, match=said):
        problem.root(0, table_with(("teacup", 0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("mask", "told"),
    [
        ({"name": "empty", "count": -1}, r"mask=empty: count=-1 must be a whole number"),
        ({"name": "empty", "count": 1.5}, r"mask=empty: count=1.5"),
        ({"name": "culprits", "at_least": -2}, r"mask=culprits: at_least=-2"),
    ],
)
def test_numbers_of_slots_are_whole_and_not_negative(mask: dict[str, object], told: str) -> None:
    with pytest.raises(InvalidInputError, match=told):
        resolve_mask(mask)
