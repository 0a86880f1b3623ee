"""Way of the settings of a post-training run: files whose functions receive them, and returns to an earlier file.

    python benchmarks/handed_down.py [--list]

Runs two iterations under ``sys.setprofile`` and records the calls that receive the configuration or one of its groups
as an argument, each pair of caller and callee once and in order. A return is a call into a file that received them
before, after a call into another file. ``--list`` prints the functions.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from agents import PostTrainConfig, post_train  # noqa: E402


def kinds_of(config: Any) -> set[type]:
    """The class of a configuration and those of its groups."""
    groups = [getattr(config, field.name) for field in dataclasses.fields(config)]
    return {type(config)}.union(*(kinds_of(group) for group in groups if dataclasses.is_dataclass(group)))


def trace(config: PostTrainConfig) -> list[tuple[str, str]]:
    """Files and functions that receive the settings, in order."""
    kinds, seen = kinds_of(config), dict[Any, tuple[str, str]]()

    def watch(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(str(ROOT)) or frame.f_back is None:
            return
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        if any(type(frame.f_locals.get(name)) in kinds for name in names):
            file = str(Path(code.co_filename).relative_to(ROOT))
            seen.setdefault((frame.f_back.f_code, code), (file, code.co_name))

    sys.setprofile(watch)
    post_train(config)
    sys.setprofile(None)
    return list(seen.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="print the functions")
    options = parser.parse_args()
    with TemporaryDirectory() as output:
        config = PostTrainConfig(
            prior="dimsum_table", reward="object_count", output=output, iterations=2, batch_size=4, num_steps=4,
            algorithm={"gradient_steps": 2}, regularisation={"batch_size": 4, "bank_size": 24}, progress="none",
            guard={"scenes": 8, "every": 1, "limit": 100.0}, logger={"checkpoint_every": 2},
        )  # fmt: skip
        calls = trace(config)
    stays = [file for (file, _), before in zip(calls, [("", ""), *calls], strict=False) if file != before[0]]
    print(f"{len(stays)} stays in {len(set(stays))} files, {len(stays) - len(set(stays))} returns to an earlier file")
    if options.list:
        print("\n".join(f"  {file}: {name}" for file, name in sorted(set(calls))))


if __name__ == "__main__":
    main()
