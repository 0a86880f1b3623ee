"""The exported scenes that these tests read back."""

from tests.helpers.export_fixtures import batch, folder, scenes

__all__ = ["batch", "folder", "scenes"]
