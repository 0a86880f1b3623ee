#!/usr/bin/env bash
# One would guess: a reader of SDF either turns a model as the quaternion in its <pose rotation_format="quat_xyzw"> says
# (SDF 1.9), or refuses the attribute, or refuses a pose of seven numbers where it expects six.
# What happens: PyBullet's loadSDF ignores the attribute and takes the last three numbers of the quaternion for roll,
# pitch and yaw, without an error or a warning. The position is right, so the scene looks nearly right.
# Whom it hurts: who writes worlds with quaternions for Gazebo or Drake, which read them, and checks them in PyBullet.
# Seen (pybullet 3.2.7), a box turned by 90 degrees about z:
#   roll, pitch, yaw 0 0 1.5708:   turned by 90.0 degrees
#   quaternion 0 0 0.7071 0.7071:  turned by 56.7 degrees
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/venv"
"$dir/venv/bin/pip" install -q pybullet==3.2.7 numpy==2.4.6
"$dir/venv/bin/python" - "$dir" <<'PYTHON'
import math
import sys
from pathlib import Path

import pybullet

WORLD = """<?xml version="1.0"?>
<sdf version="1.9"><world name="w"><model name="m"><pose{}>1 2 3 {}</pose><link name="l">
<inertial><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>
<collision name="c"><geometry><box><size>1 1 1</size></box></geometry></collision></link></model></world></sdf>
"""


def turned(attribute, rotation):
    """Angle (degrees) by which PyBullet turns the box."""
    path = Path(sys.argv[1]) / "world.sdf"
    path.write_text(WORLD.format(attribute, rotation))
    client = pybullet.connect(pybullet.DIRECT)
    (body,) = pybullet.loadSDF(str(path), physicsClientId=client)
    position, (x, y, z, w) = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    pybullet.disconnect(client)
    assert position == (1.0, 2.0, 3.0), position
    return math.degrees(2 * math.atan2(math.hypot(x, y, z), abs(w)))


half = math.sqrt(0.5)
angles = turned("", f"0 0 {math.pi / 2}")
quaternion = turned(' rotation_format="quat_xyzw"', f"0 0 {half} {half}")
print("pybullet 3.2.7")
print(f"roll, pitch, yaw 0 0 1.5708:   turned by {angles:.1f} degrees")
print(f"quaternion 0 0 0.7071 0.7071:  turned by {quaternion:.1f} degrees")
expected = math.degrees(2 * math.acos(math.cos(half / 2) ** 2))  # of pitch and yaw 0.7071
sys.exit(not (abs(angles - 90) < 0.1 and abs(quaternion - expected) < 0.1))
PYTHON
