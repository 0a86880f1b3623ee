"""What all registries of components share."""

from __future__ import annotations

from typing import Any

import pytest

from scene_envs import get_scene_type
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar


@pytest.mark.parametrize("value", [{"a": 1}, ["a"], 3, None])
def test_what_is_no_name_is_refused(value: Any) -> None:
    with pytest.raises(InvalidInputError, match=r"give a name; known: .*dimsum_table"):
        get_grammar(value)
    with pytest.raises(InvalidInputError, match="a scene type or its name is needed"):
        get_scene_type(value)
