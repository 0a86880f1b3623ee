"""A worker process: ``python -m scene_envs.physics.worker READ_FD WRITE_FD``.

It receives scene types once and chunks of poses and categories afterwards, and answers one message per chunk.
It imports neither torch nor the user's main module, and ends when its pipe closes.
"""

from __future__ import annotations

import signal
import sys
from multiprocessing.connection import Connection
from typing import Any

from scene_envs.assets.base import AssetLibrary
from scene_envs.errors import SceneEnvsError
from scene_envs.physics.kernels import KERNELS, Chunk
from scene_envs.physics.motion import physics_of
from scene_envs.scene_types import SceneType


def serve(inbox: Connection, outbox: Connection) -> None:
    """Answer messages until the other end closes."""
    scene_types: dict[int, SceneType] = {}
    outbox.send(("ready", None))
    while True:
        try:
            message = inbox.recv()
        except EOFError:
            return
        outbox.send(answer(scene_types, message))


def answer(scene_types: dict[int, SceneType], message: tuple[Any, ...]) -> tuple[str, Any]:
    """The reply to one message; ``scene_types`` are those received so far, and the message may add one."""
    kind, *body = message
    if kind == "scene_type":
        key, scene_type, assets = body
        scene_type.__dict__["library"] = AssetLibrary(assets)  # what the cached property would hold
        scene_types[key] = scene_type
        physics_of(scene_type)  # geometry is built before the first chunk's clock starts
        return "ready", None
    try:
        return "done", _run(scene_types, *body)
    except SceneEnvsError as error:
        return "refused", error
    except Exception as error:
        return "failed", f"{type(error).__name__}: {error}"


def _run(scene_types: dict[int, SceneType], kernel: str, key: int, arrays: Any, options: dict[str, Any]) -> Any:
    return KERNELS[kernel](Chunk(scene_types[key], *arrays), **options)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    read, write = int(sys.argv[1]), int(sys.argv[2])
    serve(Connection(read, writable=False), Connection(write, readable=False))
