"""Prompt-following on scenes whose contents are known."""

from __future__ import annotations

import pytest

from agents.evaluation import grammar_scenes, own_prompts, prompt_following
from agents.evaluation.measure import prompt_chance
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


@pytest.fixture(scope="module")
def real() -> SceneBatch:
    return grammar_scenes("dimsum_table", 30, seed=4)


def test_real_scenes_follow_their_own_prompts_of_every_kind(real: SceneBatch) -> None:
    prompts = own_prompts(real, seed=1)
    figures = prompt_following(real, prompts)
    assert figures["prompt_following"] == figures["prompt_score"] == 1.0
    assert figures["prompt_counts"] == figures["prompt_names"] == figures["prompt_relations"] == 1.0
    assert sum(figures[f"prompt_{kind}_number"] for kind in ("counts", "names", "relations")) == len(real)
    assert prompts == own_prompts(real, seed=1)


def test_exchanged_prompts_are_followed_by_chance_only(real: SceneBatch) -> None:
    figures = prompt_chance(real, own_prompts(real))
    assert figures["chance_prompt_following"] < 0.5
    assert figures["chance_prompt_score"] < 1.0
    assert not any(name.endswith("_number") for name in figures)


def test_every_prompt_goes_to_another_scene() -> None:
    scenes = SceneBatch.empty("dimsum_table", 5)
    prompts = ["A scene with 1 object."] * 4 + ["A scene with 2 objects."]
    assert prompt_chance(scenes, prompts)["chance_prompt_counts"] == 0.8


def test_a_prompt_is_followed_only_when_every_claim_is_true() -> None:
    scenes = SceneBatch.empty("dimsum_table", 4)
    prompts = [
        "A scene with 1 object.",
        "A scene with a table.",
        "A scene with a table and two cups.",
        "A scene where the teapot is behind the table.",
    ]
    figures = prompt_following(scenes, prompts)
    assert figures["prompt_following"] == 0.5
    assert (figures["prompt_counts"], figures["prompt_names"], figures["prompt_relations"]) == (1.0, 0.5, 0.0)
    assert figures["prompt_names_number"] == 2
    assert figures["prompt_score"] == pytest.approx((1 + 1 + 0.5 + 0.25) / 4)


def test_kinds_without_prompts_have_no_figure() -> None:
    figures = prompt_following(SceneBatch.empty("dimsum_table", 1), ["A scene with 1 object."])
    assert set(figures) == {"prompt_following", "prompt_counts", "prompt_counts_number", "prompt_score"}


def test_prompts_that_do_not_fit_are_refused(real: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match="2 prompts for 30 scenes"):
        prompt_following(real, ["A scene with 1 object."] * 2)
    with pytest.raises(InvalidInputError, match="cannot read the prompt 'Something nice'"):
        prompt_following(real[:1], ["Something nice"])
    with pytest.raises(InvalidInputError, match="at least 2 scenes"):
        prompt_chance(real[:1], ["A scene with 1 object."])
