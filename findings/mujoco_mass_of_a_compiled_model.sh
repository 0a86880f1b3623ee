#!/usr/bin/env bash
# One would guess: setting model.body_mass and model.body_inertia of a compiled MuJoCo model, as domain randomisation
# does, gives a free body another mass. Gravity then still makes it fall at 9.81 m/s^2.
# What happens: gravity acts on the new mass, but the mass matrix of a body whose joint frame is its inertial frame is
# copied from model.dof_M0, which was written when the model was compiled. A body of 1 kg that is set to 0.25 kg falls
# at a quarter of gravity. The result of mj_setConst, or dof_M0 set by hand, is right. A body whose centre of mass is
# elsewhere falls at 9.81 m/s^2 without either.
# Whom it hurts: who randomises masses, or puts other objects into one compiled model, world by world.
# Seen (mujoco 4.0.0), acceleration of fall in m/s^2:
#   as compiled, 1 kg:                       -9.81
#   body_mass and body_inertia set, 0.25 kg: -2.4525
#   dof_M0 set as well:                      -9.81
#   the same, centre of mass 1 mm aside:     -9.81
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/venv"
"$dir/venv/bin/pip" install -q mujoco==4.0.0 numpy==2.4.6
"$dir/venv/bin/python" - <<'PYTHON'
import mujoco

XML = """<mujoco><option gravity="0 0 -9.81"/><worldbody><body pos="0 0 5"><freejoint/>
<inertial pos="{aside} 0 0" mass="1" diaginertia="0.01 0.01 0.01"/><geom type="sphere" size="0.1" mass="0"/>
</body></worldbody></mujoco>"""


def fall(mass, matrix, aside=0.0):
    """Acceleration of a free body (m/s^2) whose mass is changed after the model was compiled."""
    model = mujoco.MjModel.from_xml_string(XML.format(aside=aside))
    model.body_mass[1], model.body_inertia[1] = mass, 0.01 * mass
    if matrix:
        model.dof_M0[:] = [mass] * 3 + [0.01 * mass] * 3
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return round(float(data.qacc[2]), 4)


print("mujoco", mujoco.__version__)
compiled, changed, both, aside = fall(1.0, False), fall(0.25, False), fall(0.25, True), fall(0.25, False, aside=0.001)
print("as compiled, 1 kg:                      ", compiled)
print("body_mass and body_inertia set, 0.25 kg:", changed)
print("dof_M0 set as well:                     ", both)
print("the same, centre of mass 1 mm aside:    ", aside)
raise SystemExit(0 if compiled == both == -9.81 and changed != compiled else 1)
PYTHON
