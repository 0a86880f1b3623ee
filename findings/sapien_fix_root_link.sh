#!/usr/bin/env bash
# One would guess: SAPIEN's URDF loader with fix_root_link = True fixes what it loads to the world, whatever the number of links,
# as useFixedBase does in PyBullet: a table of one link stays in the air as a cabinet with a door does.
# What happens: only a robot with joints is fixed. A URDF of one link becomes a dynamic actor and falls, without a warning.
# What fixes it is the type of the body: parse() the file and set_physx_body_type("kinematic") on its builder ("static" raises an
# AttributeError where the file gives a mass).
# Whom it hurts: who loads furniture and other static props from URDF into SAPIEN or ManiSkill: shelves and tables fall through the
# world, and all that stands on them falls with them.
# Seen (sapien 3.0.3), height of a box 1 m above the ground after 0.2 s:
#   one link, fix_root_link True:           0.8
#   two links, fix_root_link True:          1.0
#   one link, builder of type kinematic:    1.0
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/venv"
"$dir/venv/bin/pip" install -q sapien==3.0.3 "setuptools<81"
"$dir/venv/bin/python" -W ignore - "$dir" <<'PYTHON'
import sys
from pathlib import Path

import sapien
from sapien import physx

LINK = """<link name="{0}">
<inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><box size=".2 .2 .2"/></geometry></collision></link>"""
DOOR = '<joint name="hinge" type="revolute"><parent link="body"/><child link="door"/><origin xyz=".5 0 0"/>'
DOOR += '<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>'


def height(content, static):
    """Height of the loaded thing after 0.2 s, from 1 m."""
    path = Path(sys.argv[1]) / "model.urdf"
    path.write_text(f'<robot name="model">{content}</robot>')
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    scene.set_timestep(0.005)
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    articulations, actors, _ = loader.parse(str(path))
    builder = (articulations + actors)[0]
    builder.set_initial_pose(sapien.Pose([0, 0, 1]))
    if static:
        builder.set_physx_body_type("kinematic")
    loaded = builder.build()
    for _ in range(40):
        scene.step()
    return round(float(loaded.get_pose().p[2]), 2)


one, two = LINK.format("body"), LINK.format("body") + LINK.format("door") + DOOR
results = {
    "one link, fix_root_link True": height(one, False),
    "two links, fix_root_link True": height(two, False),
    "one link, builder of type kinematic": height(one, True),
}
print(f"sapien {sapien.__version__}")
for name, value in results.items():
    print(f"{name}: {value}")
sys.exit(not (results["one link, fix_root_link True"] < 0.9 and list(results.values())[1:] == [1.0, 1.0]))
PYTHON
