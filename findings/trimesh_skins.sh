#!/usr/bin/env bash
# One would guess: a skinned mesh of a glTF that trimesh loads is where viewers show it: each corner where the joints put
# it, whatever the pose of the node that holds the mesh, which the specification says to ignore.
# What happens: the skin is ignored without a warning. The mesh is straight, and at the pose of its node.
# Whom it hurts: who makes colliders, masses or pictures of rigged models (hands, lamps, characters) with trimesh.
# Seen (trimesh 5.2.0): a box whose only joint is at x = 1 m, at rest, held by a node at x = 5 m, comes out with its
# middle at x = 5 m. The specification, and the loader of three.js, put it at x = 1 m.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/venv"
"$dir/venv/bin/pip" install -q trimesh==5.2.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" - <<'PYTHON'
import base64
import json

import numpy as np
import trimesh

box = trimesh.creation.box((0.2, 0.1, 0.04))
joints = np.zeros((8, 4), "u1")
weights = np.tile(np.array([1, 0, 0, 0], "<f4"), (8, 1))
arrays = [
    (box.vertices.astype("<f4"), 5126, "VEC3"),
    (box.faces.astype("<u2").ravel(), 5123, "SCALAR"),
    (joints, 5121, "VEC4"),
    (weights, 5126, "VEC4"),
]
data, views, accessors = b"", [], []
for index, (array, kind, shape) in enumerate(arrays):
    data += bytes(-len(data) % 4)
    views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
    accessors.append({"bufferView": index, "componentType": kind, "count": len(array), "type": shape})
    data += array.tobytes()
attributes = {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}
uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
header = {
    "asset": {"version": "2.0"},
    "buffers": [{"byteLength": len(data), "uri": uri}],
    "bufferViews": views,
    "accessors": accessors,
    "meshes": [{"primitives": [{"attributes": attributes, "indices": 1}]}],
    "skins": [{"joints": [1]}],  # no inverse bind matrices: they are the identity
    "nodes": [{"mesh": 0, "skin": 0, "translation": [5, 0, 0]}, {"translation": [1, 0, 0]}],
    "scenes": [{"nodes": [0, 1]}],
}
with open("rigged.gltf", "w") as file:
    json.dump(header, file)
middle = trimesh.load_scene("rigged.gltf").bounds.mean(axis=0)
print("trimesh", trimesh.__version__, "puts the middle at x =", round(float(middle[0]), 3), "m; the skin puts it at 1 m")
raise SystemExit(0 if abs(middle[0] - 5) < 1e-6 else 1)
PYTHON
