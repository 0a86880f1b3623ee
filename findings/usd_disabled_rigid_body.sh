#!/usr/bin/env bash
# One would guess: a USD prim with PhysicsRigidBodyAPI whose physics:rigidBodyEnabled is false is a static collider, so
# that a scene can weld a prop by this one override. UsdPhysics' own parser says so: the attribute reads as false.
# What happens: Newton and MuJoCo's USD reader do not look at the attribute. The object is a free body of its mass, and
# falls. Only without the API on the composed prim is it static.
# Whom it hurts: who composes scenes of props that are rigid bodies in their own files, and fixes furniture in them.
# Seen (newton 1.8.0, mujoco-usd 4.0.0), one cube with rigidBodyEnabled = false:
#   usd-core: enabled False;  Newton: 1 body, free joint;  MuJoCo: 6 degrees of freedom
#   without the API:          Newton: 0 bodies;            MuJoCo: 0 degrees of freedom
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/newton"
"$dir/newton/bin/pip" install -q newton==1.8.0 mujoco==4.0.0 mujoco-warp==4.0.0 warp-lang==1.19.0 usd-core==26.11 newton-usd-schemas==0.6.0
python3 -m venv "$dir/mujoco"
"$dir/mujoco/bin/pip" install -q mujoco==4.0.0 mujoco-usd==4.0.0
for file in disabled without; do
  if [ $file = disabled ]; then schema='"PhysicsRigidBodyAPI", '; else schema=''; fi
  cat >"$dir/$file.usda" <<USD
#usda 1.0
(
    defaultPrim = "World"
    kilogramsPerUnit = 1
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    def PhysicsScene "scene"
    {
    }
    def Cube "block" (
        prepend apiSchemas = [${schema}"PhysicsCollisionAPI", "PhysicsMassAPI"]
    )
    {
        bool physics:rigidBodyEnabled = 0
        float physics:mass = 1
        double size = 0.1
    }
}
USD
done
"$dir/newton/bin/python" - "$dir" >"$dir/newton.txt" <<'PYTHON'
import sys
import warnings

warnings.simplefilter("ignore")
import newton
import warp
from pxr import Usd, UsdPhysics

warp.config.quiet = True
stage = Usd.Stage.Open(sys.argv[1] + "/disabled.usda")
enabled = UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath("/World/block")).GetRigidBodyEnabledAttr().Get()
found = []
for name in ("disabled", "without"):
    builder = newton.ModelBuilder()
    builder.add_usd(f"{sys.argv[1]}/{name}.usda")
    found.append((builder.body_count, builder.joint_count))
print(f"newton {newton.__version__}; usd-core: enabled {enabled}; bodies and joints, disabled {found[0]}, without {found[1]}")
PYTHON
"$dir/mujoco/bin/python" - "$dir" >"$dir/mujoco.txt" <<'PYTHON'
import sys

import mujoco
import mujoco._usd

found = [mujoco.MjSpec.from_file(f"{sys.argv[1]}/{name}.usda").compile().nv for name in ("disabled", "without")]
print(f"mujoco {mujoco.__version__}; degrees of freedom, disabled {found[0]}, without {found[1]}")
PYTHON
tail -n 1 "$dir/newton.txt"
tail -n 1 "$dir/mujoco.txt"
grep -q "enabled False; bodies and joints, disabled (1, 1), without (0, 0)" "$dir/newton.txt"
grep -q "disabled 6, without 0" "$dir/mujoco.txt"
