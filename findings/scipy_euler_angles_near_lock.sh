#!/usr/bin/env bash
# One would guess: Rotation.as_euler gives angles whose rotation is the one that was given, to rounding. Its page says
# that at gimbal lock the third angle is set to zero, and that the angles still represent the correct rotation.
# What happens: it takes every rotation within 1e-7 rad of the lock for one at the lock, and sets the third angle to
# zero there too. The rotation of the angles is then wrong by up to 1e-7, a hundred million times the rounding.
# Whom it hurts: who writes poses as roll, pitch and yaw, as SDF and URDF have them, and needs them back exactly.
# Angles that first undo the yaw have no error there.
# Seen (scipy 1.17.1, numpy 2.4.6), largest error of an entry of the matrix, roll 2 rad and yaw -3 rad:
#   pitch 90 degrees - 0e+00 rad: as_euler 4.4e-16, yaw undone first 3.3e-16
#   pitch 90 degrees - 1e-08 rad: as_euler 2.0e-08, yaw undone first 3.3e-16
#   pitch 90 degrees - 5e-08 rad: as_euler 9.9e-08, yaw undone first 3.3e-16
#   pitch 90 degrees - 1e-06 rad: as_euler 6.1e-16, yaw undone first 2.2e-16
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/venv"
"$dir/venv/bin/pip" install -q numpy==2.4.6 scipy==1.17.1
"$dir/venv/bin/python" - <<'PYTHON'
import warnings

import numpy as np
from scipy.spatial.transform import Rotation


def turn(axis, angle):
    return Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()


def matrix(angles):
    return turn(2, angles[2]) @ turn(1, angles[1]) @ turn(0, angles[0])


def undone(m):
    yaw = np.arctan2(m[1, 0], m[0, 0])
    sin, cos = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-m[2, 0], cos * m[0, 0] + sin * m[1, 0])
    return np.arctan2(sin * m[0, 2] - cos * m[1, 2], cos * m[1, 1] - sin * m[0, 1]), pitch, yaw


warnings.simplefilter("ignore")
worst = {}
for off in (0.0, 1e-8, 5e-8, 1e-6):
    given = matrix((2.0, np.pi / 2 - off, -3.0))
    found = [np.abs(matrix(angles) - given).max() for angles in (Rotation.from_matrix(given).as_euler("xyz"), undone(given))]
    print(f"pitch 90 degrees - {off:.0e} rad: as_euler {found[0]:.1e}, yaw undone first {found[1]:.1e}")
    worst[off] = found
raise SystemExit(0 if worst[5e-8][0] > 1e-8 and max(row[1] for row in worst.values()) < 1e-14 else 1)
PYTHON
