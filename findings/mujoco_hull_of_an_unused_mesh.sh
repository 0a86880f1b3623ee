#!/usr/bin/env bash
# One would guess: a mesh of a compiled MuJoCo model can be given to a geometry by geom_dataid, whatever geometry had it.
# What happens: MuJoCo makes the convex hull and the polygons of a mesh with faces only where a geometry that collides has
# that mesh when the model is compiled. Given to a geometry later, any other mesh still collides, without a warning, with
# one contact where there should be four: boxes then rock. A place for each mesh in the model is the remedy.
# Whom it hurts: who puts other meshes into parallel worlds of one model (MuJoCo Warp: geom_dataid per world).
# Seen (mujoco 4.0.0), a box on a box:
#   mesh that a colliding geometry has:   4 contacts
#   mesh that no geometry has, by dataid: 1 contacts
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/venv"
"$dir/venv/bin/pip" install -q mujoco==4.0.0 numpy==2.4.6
"$dir/venv/bin/python" - <<'PYTHON'
import mujoco

CORNERS = " ".join(f"{x} {y} {z}" for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))
FACES = "0 1 3 0 3 2 4 6 7 4 7 5 0 4 5 0 5 1 2 3 7 2 7 6 0 2 6 0 6 4 1 5 7 1 7 3"
XML = f"""<mujoco><asset><mesh name="one" vertex="{CORNERS}" face="{FACES}"/>
<mesh name="other" vertex="{CORNERS}" face="{FACES}"/></asset><worldbody><geom type="mesh" mesh="one"/>
<body pos="0.1 0 1.999"><freejoint/><geom type="mesh" mesh="one"/></body></worldbody></mujoco>"""


def contacts(mesh):
    """Number of contacts of the two boxes, both of which have this mesh."""
    model = mujoco.MjModel.from_xml_string(XML)
    model.geom_dataid[:] = mesh
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.ncon


print("mujoco", mujoco.__version__)
used, unused = contacts(0), contacts(1)
print(f"mesh that a colliding geometry has:   {used} contacts")
print(f"mesh that no geometry has, by dataid: {unused} contacts")
raise SystemExit(0 if used == 4 and unused == 1 else 1)
PYTHON
