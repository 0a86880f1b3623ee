"""The words of the grammar language, and a user's own grammar."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from scipy import stats

from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import (
    NOTHING,
    Disc,
    FreeSurface,
    Gaussian,
    Geometric,
    Grammar,
    Group,
    Object,
    OneOf,
    Outline,
    Region,
    Repeat,
    Stack,
    Surface,
    Yaw,
    get_grammar,
    list_grammars,
    register_grammar,
)
from scene_envs.scene_types import get_scene_type

HERE = Gaussian()


def test_geometric_has_the_stated_probabilities() -> None:
    rng = np.random.default_rng(0)
    draws = np.bincount([Geometric(0.6, 1, 4, present=0.9).draw(rng) for _ in range(20_000)], minlength=5)
    weights = np.array([1.0, 0.4, 0.16, 0.064])
    expected = np.r_[0.1, 0.9 * weights / weights.sum()]
    assert stats.chisquare(draws, expected * draws.sum()).pvalue > 1e-4


def test_one_of_draws_by_weight_and_group_draws_all() -> None:
    node = OneOf((3.0, Group(Object("a", HERE), Object("b", HERE))), (1.0, NOTHING))
    rng, reasons = np.random.default_rng(0), Counter[str]()
    sizes = Counter(len(node.draw(rng, reasons)) for _ in range(8000))
    assert set(sizes) == {0, 2}
    assert sizes[2] / 8000 == pytest.approx(0.75, abs=0.02)


def test_stack_heights_are_geometric_and_bounded() -> None:
    rng, reasons = np.random.default_rng(0), Counter[str]()
    stack = Stack("box", {"box": 0.5, "lid": 0.25, None: 0.25}, step=0.1, where=HERE, at_most=3)
    towers = [stack.draw(rng, reasons)[0].assets for _ in range(16_000)]
    assert max(map(len, towers)) == 3
    assert all("lid" not in assets[:-1] for assets in towers)
    # Unbounded: P(1) = 1/4 (box, stop), P(2) = 1/4 + 1/8, P(3) = 1/8 + 1/16; conditioned on at most 3.
    observed = np.bincount([len(assets) for assets in towers])[1:]
    expected = np.array([4, 6, 3]) / 13
    assert stats.chisquare(observed, expected * 16_000).pvalue > 1e-4
    assert reasons["stack of box above 3"] > 0


def test_repeat_draws_again_until_its_conditions_hold_and_says_why() -> None:
    reasons: Counter[str] = Counter()
    node = Repeat(Object("a", HERE), Geometric(0.5, 0, 5), {"fewer than 3": lambda towers: len(towers) >= 3})
    sizes = [len(node.draw(np.random.default_rng(i), reasons)) for i in range(200)]
    assert min(sizes) >= 3
    assert reasons["fewer than 3"] > 0


def test_one_of_without_positive_weight_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="positive sum"):
        OneOf((0.0, NOTHING))


def test_placement_keeps_distance_on_a_crowded_surface_and_says_when_it_is_full() -> None:
    surface, rng = FreeSurface(Region(0.5, 0.5)), np.random.default_rng(0)
    disc = Outline((Disc(0.1),), (Disc(0.0),))
    spots = []
    while (spot := surface.place(Gaussian(along=0.05), Yaw(), disc, rng)) is not None:
        spots.append(spot)
    # Random placement of discs of diameter 0.2 with centres in a unit square: jamming leaves no free cell.
    assert 18 <= len(spots) <= 35
    assert min(math.dist(a[:2], b[:2]) for i, a in enumerate(spots) for b in spots[:i]) >= 0.2
    assert max(max(map(abs, spot[:2])) for spot in spots) <= 0.5


def test_placement_follows_its_distribution_cut_to_the_free_region() -> None:
    rng = np.random.default_rng(0)
    where = Gaussian(x=0.6, y=0.0, along=0.05)
    disc = Outline((Disc(0.1),), (Disc(0.0),))
    xs = [FreeSurface(Region(0.475, 0.475)).place(where, Yaw(), disc, rng) for _ in range(600)]
    mean = np.mean([spot[0] for spot in xs if spot is not None])
    expected = stats.truncnorm(-np.inf, (0.475 - 0.6) / 0.05, loc=0.6, scale=0.05).mean()
    assert mean == pytest.approx(expected, abs=4e-3)


def test_gaussian_is_rotated_by_its_direction() -> None:
    rng = np.random.default_rng(0)
    points = np.array([Gaussian(1, 2, along=0.3, across=0.1, direction=math.pi / 2).draw(rng) for _ in range(4000)])
    np.testing.assert_allclose(points.mean(axis=0), [1, 2], atol=0.02)
    np.testing.assert_allclose(points.std(axis=0), [0.1, 0.3], rtol=0.05)


def _tea_party() -> Grammar:
    cups = Repeat(Object("teacup", HERE), Geometric(0.5, 1, 3))
    surface = Surface([cups], Region(0.3, 0.3), keep_out={"teacup": 0.07}, footprint={"teacup": 0.07})
    conditions = {"no pair": lambda towers: len(towers) >= 2}
    return Grammar("tea_party", get_scene_type("dimsum_table"), [surface], conditions)


def test_a_users_grammar_is_found_by_name_and_its_conditions_hold() -> None:
    register_grammar("tea_party")(_tea_party)
    assert "tea_party" in list_grammars()
    grammar = get_grammar("tea_party")
    batch = grammar.sample(np.random.default_rng(0), 50)
    assert set(batch.counts.tolist()) == {3, 4}
    assert grammar.reasons["no pair"] > 0


def test_an_unknown_grammar_offers_the_nearest_name() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'dimsum_table'"):
        get_grammar("dimsum_tabel")


def test_a_grammar_that_cannot_be_met_says_so() -> None:
    crowd = Surface([Group(*[Object("teacup", HERE)] * 5)], Region(0.05, 0.05), {"teacup": 0.07}, {"teacup": 0.07})
    grammar = Grammar("crowd", get_scene_type("dimsum_table"), [crowd])
    with pytest.raises(InvalidInputError, match=r"no room for 'teacup' beside 'teacup' \(\d+\)"):
        grammar.sample(np.random.default_rng(0))
