"""Verdicts on the candidates of a shard under way, so that an interrupted shard is not judged again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scene_envs.datasets.store import storage_error


class Journal:
    """An append-only text file with one verdict per line, in the order of the candidates.

    A process may be killed while it writes: a last line without its end is dropped.

    Args:
        path: the file; made by the first :meth:`append`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[str]:
        """The verdicts so far; what follows the last whole line is cut off the file."""
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            return []
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            self.path.write_bytes(whole)
        return whole.decode(errors="replace").split("\n")[:-1]

    def append(self, verdicts: Sequence[str]) -> None:
        """Add verdicts; raises :class:`~scene_envs.datasets.store.StorageError`."""
        try:
            with self.path.open("ab") as file:
                file.write("".join(f"{verdict}\n" for verdict in verdicts).encode())
        except OSError as error:
            raise storage_error(self.path, error) from error

    def remove(self) -> None:
        """Forget it, when the shard is written."""
        self.path.unlink(missing_ok=True)
