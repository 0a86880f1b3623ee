"""Journal of an unfinished shard, for resuming it: digests of its candidates, and verdicts on them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scene_envs.files import storage_error


class Journal:
    """An append-only text file with the number of a candidate and its verdict per line.

    A process may be killed while it writes, so an incomplete last line is dropped. Two processes that make the same
    shard may write by turns, because a worker may outlive its killed parent for a moment; a verdict that is
    written twice counts once. The first :meth:`append` makes the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[str]:
        """The verdicts on candidates 0, 1, … so far; an incomplete last line is cut off the file.

        Raises:
            StorageError: the file cannot be read or written.
        """
        try:
            content = self.path.read_bytes()
            whole = content[: content.rfind(b"\n") + 1]
            if len(whole) < len(content):
                self.path.write_bytes(whole)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise storage_error(self.path, error) from error
        verdicts: list[str] = []
        for line in whole.decode(errors="replace").split("\n")[:-1]:
            candidate, _, verdict = line.partition(" ")
            if candidate == str(len(verdicts)):
                verdicts.append(verdict)
        return verdicts

    def append(self, first: int, verdicts: Sequence[str]) -> None:
        """Add the verdicts on candidates ``first``, ``first + 1``, …

        Raises:
            StorageError: the file cannot be written.
        """
        lines = "".join(f"{candidate} {verdict}\n" for candidate, verdict in enumerate(verdicts, start=first))
        try:
            with self.path.open("ab") as file:
                file.write(lines.encode())
        except OSError as error:
            raise storage_error(self.path, error) from error

    def remove(self) -> None:
        """Delete the file, when the shard is written."""
        self.path.unlink(missing_ok=True)
