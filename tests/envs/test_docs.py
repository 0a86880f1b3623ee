"""Pages under docs/envs: agreement with the docstrings and with Gymnasium's order of sections."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from scene_envs.envs import DenoisingEnv, SearchEnv, SearchMaskEnv

DOCS = Path(__file__).parents[2] / "docs" / "envs"
SECTIONS = [
    "Description",
    "Action Space",
    "Observation Space",
    "Rewards",
    "Starting State",
    "Episode End",
    "Arguments",
    "Vectorized environment",
    "Version History",
]


@pytest.mark.parametrize(
    ("page", "env"), [("denoising", DenoisingEnv), ("search", SearchEnv), ("search_mask", SearchMaskEnv)]
)
def test_page_is_the_docstring_in_gymnasiums_order(page, env):
    docstring = inspect.getdoc(env) or ""
    assert (DOCS / f"{page}.md").read_text().endswith(f"\n{docstring}\n"), "copy the docstring into the page"
    assert [line[3:] for line in docstring.splitlines() if line.startswith("## ")] == SECTIONS


@pytest.mark.parametrize("env", [DenoisingEnv, SearchEnv, SearchMaskEnv])
def test_every_argument_is_in_the_table_with_its_default(env):
    others = [SearchEnv] if env is SearchMaskEnv else []  # whose page says that its other arguments are the same
    rows = [row for one in (env, *others) for row in (inspect.getdoc(one) or "").splitlines()]
    for name, parameter in inspect.signature(env).parameters.items():
        default = f'"{parameter.default}"' if isinstance(parameter.default, str) else str(parameter.default)
        assert any(row.startswith(f"| `{name}` | `{default}` |") for row in rows), name
