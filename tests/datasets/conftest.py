"""A small generated dataset that several files of this folder compare with."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.toy_grammars import generate_cups


@pytest.fixture(scope="session")
def cups(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What an undisturbed run of :func:`generate_cups` writes; left as it is by all tests."""
    folder = tmp_path_factory.mktemp("cups")
    generate_cups(folder)
    return folder
