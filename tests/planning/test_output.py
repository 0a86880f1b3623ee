"""Trees of searches: the file on disk and its HTML page."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.planning import SearchOutcome, SearchRecord, list_planners, run_search
from agents.planning.output import MAX_OTHER_SCENES, MAX_PATH_SCENES, _cards, shown_nodes, write_tree_page
from agents.priors.testing import tiny_prior
from rewards import RewardContext, RewardOutput
from scene_envs.envs import SearchState
from scene_envs.errors import CorruptFileError
from scene_envs.scene import SceneBatch
from tests.helpers.browser import Browser

SETTINGS: dict[str, Any] = {"branching": 3, "num_steps": 2, "max_depth": 5, "seed": 3, "mask": "random", "slots": 8}
SETTINGS["objective_scale"] = 20.0  # of which 7 can be reached: no search ends early


def central_objects(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Free objects within 10 cm of the middle, the others are to blame; a scene of less than 3 objects has no score."""
    central = batch.is_free & (batch.translations[..., :2].norm(dim=-1) < 0.1)
    return RewardOutput(central.sum(-1).float(), valid=batch.is_free.sum(-1) > 2, object_flags={"feasible": central})


def search(output: Path, **settings: Any) -> SearchOutcome:
    settings = {**SETTINGS, "budget": 9, "baseline": False, **settings}
    return run_search(tiny_prior(slots=8), central_objects, output=output, **settings)


def chain(depth: int, width: int) -> tuple[list[SearchState], dict[int, tuple[int, ...]]]:
    """A root and ``width`` children at each of ``depth`` steps, of which the last is inpainted on; values rise."""
    scene = SceneBatch.empty("dimsum_table", 1).tensor[0]
    masks = torch.arange(34)[None] == 2
    states, path = [SearchState(scene, masks, 0, (), 5, 0.0, 0.0, True)], ()
    for step in range(1, depth + 1):
        states += [
            SearchState(scene, masks, step, (*path, k), 5, step / depth, float(step), True) for k in range(width)
        ]
        path = (*path, width - 1)
    return states, {5: path}


def recorded(depth: int, width: int) -> tuple[SearchRecord, list[SearchState]]:
    states, best = chain(depth, width)
    settings = {"planner": "greedy", "objective": "toy", "objective_scale": float(depth), "nfe_per_scene": 2}
    return SearchRecord.of(states[:1], states[1:], best, settings), states


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[SearchOutcome, Path]:
    output = tmp_path_factory.mktemp("search")
    return search(output, planner="mcts", count=2, baseline=True), output


@pytest.mark.slow
@pytest.mark.parametrize("planner", list_planners())
def test_every_planner_leaves_its_tree(planner: str, tmp_path: Path) -> None:
    outcome = search(tmp_path, planner=planner)
    record = SearchRecord.load(tmp_path / "tree.json")
    root, *nodes = record.nodes
    assert (root.parent, root.action, root.depth, root.nfe) == (None, None, 0, 0)
    assert [node.id for node in nodes] == list(range(1, len(outcome.search.values) + 1))
    assert [node.nfe for node in nodes] == [2 * node.id for node in nodes]
    values = [None if value != value else value for value in outcome.search.values]
    assert [node.value for node in nodes] == values
    assert all(node.parent < node.id and record.nodes[node.parent].depth == node.depth - 1 for node in nodes)
    path = record.path(record.searches[0]["best"])
    assert tuple(record.nodes[node].action for node in path[1:]) == tuple(outcome.search.best_path)
    assert root.visits == sum(node.value is not None for node in record.nodes)
    page = (tmp_path / "tree.html").read_text()
    assert f"{planner} on dimsum table: {len(nodes)} scenes" in page
    assert 'src="http' not in page
    assert page.count("<canvas width") == len(shown_nodes(record))


@pytest.mark.slow
def test_searches_side_by_side_are_trees_of_their_own(run: tuple[SearchOutcome, Path]) -> None:
    outcome, output = run
    record = SearchRecord.load(output / "tree.json")
    assert [search["seed"] for search in record.searches] == [plan.best_state.seed for plan in outcome.searches]
    trees = [record.tree_of(k) for k in range(2)]
    assert sorted(node.id for tree in trees for node in tree) == list(range(len(record.nodes)))
    for tree, plan in zip(trees, outcome.searches, strict=True):
        assert len(tree) == len(plan.values) + 1
        assert max(node.value or 0.0 for node in tree[1:]) == plan.best_value


def test_visits_and_masks_are_those_of_the_states() -> None:
    record, states = recorded(depth=4, width=3)
    assert record.nodes[0].visits == len(states)
    assert [record.nodes[node].visits for node in record.path(record.searches[0]["best"])] == [13, 10, 7, 4, 1]
    assert record.nodes[1].mask == (2,)


@pytest.mark.slow
def test_a_run_that_goes_on_writes_the_whole_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.planning.search_run.draw_scene", lambda *_: None)
    search(tmp_path, planner="beam")
    before = SearchRecord.load(tmp_path / "tree.json")
    search(tmp_path, planner="beam", budget=12)
    after = SearchRecord.load(tmp_path / "tree.json")
    assert len(after.nodes) > len(before.nodes)
    assert [(n.parent, n.action, n.value) for n in after.nodes[: len(before.nodes)]] == [
        (n.parent, n.action, n.value) for n in before.nodes
    ]


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    record, _ = recorded(depth=3, width=2)
    record.save(tmp_path / "tree.json")
    assert SearchRecord.load(tmp_path / "tree.json") == record


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text[: len(text) // 2], "truncated or no search tree"),
        (lambda text: text.replace('"value": 1.0', '"value": 0.9'), "was changed after it was written"),
        (lambda text: "[1, 2]", "no search tree"),
        (lambda text: "\x00\xff", "no search tree"),
        (lambda text: text.replace("search tree 1", "search tree 7"), "'scene-envs search tree 1' is needed"),
    ],
)
def test_a_damaged_file_is_an_error(tmp_path: Path, damage: Any, message: str) -> None:
    path = tmp_path / "tree.json"
    recorded(depth=3, width=2)[0].save(path)
    path.write_text(damage(path.read_text()))
    with pytest.raises(CorruptFileError, match=message):
        SearchRecord.load(path)


def test_cards_have_a_place_each_and_the_best_path_the_first_row() -> None:
    record, _ = recorded(depth=6, width=4)
    cards = _cards(record, shown_nodes(record), record.path(record.searches[0]["best"])[1:])
    assert len({(card.column, card.row) for card in cards}) == len(cards) == 24
    assert [card.row for card in cards if card.on_path] == [0] * 6
    assert all(card.column == card.node.depth - 1 for card in cards)
    assert max(card.row for card in cards) == 3
    for card in cards:
        assert card.parent is None or cards[card.parent].node.id == card.node.parent


@pytest.mark.slow
def test_the_page_of_thousands_of_scenes_is_small(tmp_path: Path) -> None:
    record, _ = recorded(depth=1250, width=4)
    shown = shown_nodes(record)
    assert len(shown) == MAX_PATH_SCENES + MAX_OTHER_SCENES
    path = record.path(record.searches[0]["best"])
    assert shown[:MAX_PATH_SCENES:MAX_PATH_SCENES] == path[1:2]
    assert shown[MAX_PATH_SCENES - 1] == path[-1]
    assert all(a < b for a, b in pairwise(shown[:MAX_PATH_SCENES]))
    page = tmp_path / "tree.html"
    write_tree_page(page, record, dict.fromkeys(shown, search_scene()), metrics_of(record))
    assert page.stat().st_size < 10_000_000
    record.save(tmp_path / "tree.json")
    assert (tmp_path / "tree.json").stat().st_size < 2_000_000


def search_scene() -> SceneBatch:
    import numpy as np

    from scene_envs.grammars import get_grammar

    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 1)


def metrics_of(record: SearchRecord) -> dict[str, Any]:
    plan = {"value": 1.0, "objective": 6.0, "expansions": len(record.nodes) - 1}
    nfe = 2 * (len(record.nodes) - 1)
    return {
        "planner": "greedy", "objective": "</script><b>", "objective_scale": 6.0, "search": plan, "nfe": nfe,
        "first_samples": plan, "seconds": {"search": 1.0}, "best_of": {**plan, "curve": [0.5, None, 0.75]},
    }  # fmt: skip


@pytest.mark.slow
def test_a_browser_plays_the_path_and_shows_what_is_clicked(coarse_browser: Browser, tmp_path: Path) -> None:
    browser = coarse_browser
    record, _ = recorded(depth=3, width=3)
    scenes = dict.fromkeys(shown_nodes(record), search_scene())
    path = tmp_path / "tree.html"
    write_tree_page(path, record, scenes, metrics_of(record), returned=search_scene())
    assert "</script><b>" not in path.read_text()
    browser.send("Page.navigate", url=path.as_uri())
    inside = "document.getElementById('viewer')?.contentDocument?.body?.dataset"
    browser.wait_for(f"document.body?.dataset.state === 'ready' && {inside}?.state === 'ready'")
    browser.run("document.querySelector('.family').scrollIntoView()")
    browser.wait_for("document.querySelectorAll('[data-painted]').length > 2")
    colors = "new Set(document.querySelector('.card canvas').getContext('2d').getImageData(0, 0, 200, 150).data).size"
    assert browser.run(colors) > 50
    shown = json.loads(browser.run(f"JSON.stringify({inside})"))
    assert (shown["scenes"], shown["scene"], shown["errors"]) == (str(len(scenes) + 1), "0", "0")
    browser.run("document.querySelectorAll('button.card')[4].click()")
    browser.wait_for(f"{inside}.scene === document.querySelectorAll('button.card')[4].dataset.frame")
    browser.run("document.getElementById('play').click()")
    browser.wait_for("document.getElementById('playing').textContent === 'step 4 of 4'")
    assert browser.run(f"{inside}.scene") == str(len(scenes))  # the scene that the search returned
    assert "play" in browser.run("document.getElementById('play').textContent")
    dots = browser.run("document.querySelector('#plot .dots').getAttribute('d').split('M').length - 1")
    assert dots == len(record.nodes) - 1
    assert browser.exceptions == []
