#!/usr/bin/env bash
# One would guess: PhysicsArticulationRootAPI on the Xform above the links of a cabinet marks them as one articulation, as
# UsdPhysics says ("an ancestor of the articulation's bodies"), and adds no body.
# What happens: MuJoCo's USD reader makes every prim that has this API a body. The Xform has no mass, so that the model does
# not compile. The API on a link, here the one that a fixed joint holds at the world, works in MuJoCo and in Newton.
# Whom it hurts: who writes articulations with the API on the root prim of the asset, as Isaac Sim does.
# Seen (mujoco-usd 4.0.0):
#   on the Xform: Error: mass and inertia of moving bodies must be larger than mjMINVAL, '/World/cabinet'
#   on the link:  1 joint, range 0 to 1.57
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv "$dir/mujoco"
"$dir/mujoco/bin/pip" install -q mujoco==4.0.0 mujoco-usd==4.0.0
for place in Xform link; do
  above=''; on=''
  if [ $place = Xform ]; then above='( prepend apiSchemas = ["PhysicsArticulationRootAPI"] )'; else on='"PhysicsArticulationRootAPI", '; fi
  cat >"$dir/$place.usda" <<USD
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
    def Xform "cabinet" $above
    {
        def Cube "box" ( prepend apiSchemas = [$on"PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI"] )
        {
            float physics:mass = 1
            double size = 0.1
        }
        def Cube "door" ( prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI"] )
        {
            float physics:mass = 1
            double size = 0.1
            double3 xformOp:translate = (0.2, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
        def PhysicsFixedJoint "weld"
        {
            rel physics:body1 = </World/cabinet/box>
        }
        def PhysicsRevoluteJoint "hinge"
        {
            uniform token physics:axis = "Z"
            rel physics:body0 = </World/cabinet/box>
            rel physics:body1 = </World/cabinet/door>
            point3f physics:localPos0 = (0.1, 0, 0)
            point3f physics:localPos1 = (-0.1, 0, 0)
            float physics:lowerLimit = 0
            float physics:upperLimit = 90
        }
    }
}
USD
  echo "on the $place:"
  "$dir/mujoco/bin/python" -c "
import mujoco
import mujoco._usd

try:
    model = mujoco.MjSpec.from_file('$dir/$place.usda').compile()
    print(' ', model.njnt, 'joint, range', model.jnt_range[0].round(2))
except ValueError as error:
    print(' ', str(error).replace('\n', ' '))
"
done
