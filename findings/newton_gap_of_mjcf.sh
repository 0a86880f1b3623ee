#!/usr/bin/env bash
# One would guess: an MJCF file that says nothing of a contact's gap has MuJoCo's default in Newton too, which is 0, most
# of all with Newton's MuJoCo solver: two boxes that are 5 cm apart are not in contact.
# What happens: Newton's importer gives every geometry the gap of its own default, 0.1 m, and its MuJoCo solver passes
# it on as geom_gap. Everything within 20 cm becomes a contact; stacks of hollow objects get hundreds of them.
# Whom it hurts: who loads MJCF scenes of many small objects into Newton. Steps are slow, buffers of contacts overflow,
# and crowded scenes that rest in MuJoCo may fly apart. A file that says gap="0" is read as meant.
# Seen (newton 1.8.0, mujoco 4.0.0), boxes on a plane, 5 cm apart:
#   MuJoCo:                 gap 0.0, 8 contacts, none between the boxes
#   Newton, nothing said:   gap 0.1, 12 contacts, 4 between the boxes
#   Newton, gap="0":        gap 0.0, 8 contacts, none between the boxes
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/venv"
"$dir/venv/bin/pip" install -q newton==1.8.0 mujoco==4.0.0 mujoco-warp==4.0.0 warp-lang==1.19.0
"$dir/venv/bin/python" - "$dir" <<'PYTHON'
import sys
import warnings
from pathlib import Path

warnings.simplefilter("ignore")
import mujoco
import newton
import warp

warp.config.quiet = True
MODEL = """<mujoco><worldbody><geom type="plane" size="1 1 .1"{0}/>
<body pos="0 0 .05"><freejoint/><geom type="box" size=".05 .05 .05"{0}/></body>
<body pos=".15 0 .05"><freejoint/><geom type="box" size=".05 .05 .05"{0}/></body>
</worldbody></mujoco>"""


def found(model):
    """The largest gap, the number of contacts, and how many of them are further apart than 1 cm."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return round(float(model.geom_gap.max()), 3), data.ncon, int((data.contact.dist > 0.01).sum())


def in_newton(text):
    path = Path(sys.argv[1]) / "model.xml"
    path.write_text(text)
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_mjcf(str(path))
    return found(newton.solvers.SolverMuJoCo(builder.finalize(device="cpu"), use_mujoco_cpu=True).mj_model)


results = {
    "MuJoCo": found(mujoco.MjModel.from_xml_string(MODEL.format(""))),
    "Newton, nothing said": in_newton(MODEL.format("")),
    'Newton, gap="0"': in_newton(MODEL.format(' gap="0"')),
}
print(f"newton {newton.__version__}, mujoco {mujoco.__version__}")
for name, (gap, contacts, apart) in results.items():
    print(f"{name}: gap {gap}, {contacts} contacts, {apart} between the boxes")
sys.exit(list(results.values()) != [(0.0, 8, 0), (0.1, 12, 4), (0.0, 8, 0)])
PYTHON
