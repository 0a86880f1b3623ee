"""Memory of the scenes that built-in grammars drew, for tests that ask for the same ones again."""

from __future__ import annotations

import os
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_envs.grammars.grammar import Grammar
from scene_envs.scene_types.built_in import BUILT_IN

_DRAWN_ANEW = ("tests/grammars/", "tests/datasets/", "tests/docs/", "scene_envs/")
"""Where the drawing itself is tested."""
_MOST = 3000
"""Scenes that are kept."""


def keep_scenes() -> None:
    """From now on, a scene of a built-in grammar is drawn once from each state of a generator, which takes up to 0.3 s.

    What is drawn, the state that the generator is left in, and the reasons that the grammar counts are the same.
    """
    names, draw = {scene_type.name for scene_type in BUILT_IN}, Grammar._fill
    known: dict[tuple[str, str], tuple[NDArray[np.float32], Any, Counter[str]]] = {}

    def once(self: Grammar, scene: NDArray[np.float32], rng: np.random.Generator) -> None:
        anew = os.environ.get("PYTEST_CURRENT_TEST", "scene_envs/").startswith(_DRAWN_ANEW)
        if anew or type(self) is not Grammar or self.name not in names:
            return draw(self, scene, rng)
        key = (self.name, repr(rng.bit_generator.state))
        if key not in known:
            before = self.reasons.copy()
            draw(self, scene, rng)
            if len(known) < _MOST:
                known[key] = (scene.copy(), rng.bit_generator.state, self.reasons - before)
            return None
        scene[:], rng.bit_generator.state, reasons = known[key]
        self.reasons.update(reasons)
        return None

    Grammar._fill = once  # type: ignore[method-assign]
