"""A process that decomposes one mesh by CoACD: ``python -m scene_envs.assets.importing.coacd_worker MESH RESULT``.

CoACD works in compiled code that nothing interrupts; in a process of its own it can be ended.
"""

from __future__ import annotations

import json
import sys

import numpy as np


def main(source: str, target: str) -> None:
    """Read ``vertices``, ``faces`` and ``settings`` from one npz file, write ``vertices`` and ``counts`` to another."""
    import coacd

    with np.load(source, allow_pickle=False) as mesh:
        vertices, faces, settings = mesh["vertices"], mesh["faces"], json.loads(str(mesh["settings"]))
    coacd.set_log_level("error")
    found = [np.asarray(corners) for corners, _ in coacd.run_coacd(coacd.Mesh(vertices, faces), **settings)]
    counts = np.array([len(piece) for piece in found], dtype=np.int64)
    np.savez(target, vertices=np.concatenate([np.zeros((0, 3)), *found]), counts=counts)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
