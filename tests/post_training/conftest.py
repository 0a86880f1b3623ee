"""Pictures of runs, which one file of this folder looks at."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _blank_curves(request: pytest.FixtureRequest) -> None:
    if request.module.__name__.rpartition(".")[2] != "test_post_training_reports":
        request.getfixturevalue("blank_curves")
