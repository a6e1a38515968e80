#!/usr/bin/env bash
# SAPIEN: the friction of a URDF's joints is not read. Each joint has a coefficient of 0.05, also where the URDF says 0, 0.02
# or nothing. No warning. PhysX multiplies it by the force and torque in the joint, without units. So 1 N allows 0.05 N m of
# friction. Arms hardly feel it, and fingers stick. A pendulum of 5 cm, let go level, does not reach its lowest point in 10 s.
# One of 5 mm sticks more than 60 degrees before it. MuJoCo swings both to the other side. So does SAPIEN with
# joint.set_friction(0).
# Packages: sapien 3.0.3, mujoco 3.17.0, numpy 2.4.6; Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check sapien==3.0.3 mujoco==3.17.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import sys
import warnings

import mujoco
import numpy as np

warnings.simplefilter("ignore")  # of a missing driver for pictures
import sapien

STEP = 0.001  # [s]
MASS = 0.1  # [kg]
ZERO = '<dynamics damping="0" friction="0"/>'
URDF = """<robot name="hand">
<link name="palm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="finger"><inertial><origin xyz="{0} 0 0"/><mass value="{1}"/><inertia ixx="{2}" iyy="{2}" izz="{2}" ixy="0" ixz="0"
iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="palm"/><child link="finger"/><axis xyz="0 1 0"/>
<limit lower="-6" upper="6" effort="9" velocity="99"/>{3}</joint></robot>"""


def load(length, dynamics, friction=None):
    """Return SAPIEN's scene and hand, and MuJoCo's model, of a finger of the given length [m]."""
    text = URDF.format(length, MASS, 0.01 * MASS * length**2, dynamics)
    file = f"{sys.argv[1]}/hand.urdf"
    with open(file, "w") as stream:
        stream.write(text)
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.timestep = STEP
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    hand = loader.load(file)
    if friction is not None:
        hand.active_joints[0].set_friction(friction)
    return scene, hand, mujoco.MjModel.from_xml_string(text)


def swing(length, friction=None):
    """Return how far [degrees] the finger falls within 10 s in SAPIEN and in MuJoCo; the lowest point is at 90."""
    scene, hand, model = load(length, ZERO, friction)
    model.opt.timestep = STEP
    data = mujoco.MjData(model)
    far = [0.0, 0.0]
    for _ in range(10_000):
        scene.step()
        mujoco.mj_step(model, data)
        far = [max(far[0], hand.qpos[0]), max(far[1], data.qpos[0])]
    return np.rad2deg(far)


print("sapien", sapien.__version__, "mujoco", mujoco.__version__)
for dynamics, true in (("", 0), (ZERO, 0), ('<dynamics damping="0" friction="0.02"/>', 0.02)):
    _, hand, model = load(0.05, dynamics)
    read = hand.active_joints[0].friction
    print(f"{dynamics or 'no dynamics'}: SAPIEN has {read:.3g}, MuJoCo {model.dof_frictionloss[0]:.3g} N m")
    assert np.isclose(read, 0.05) and np.isclose(model.dof_frictionloss[0], true)
for length, least, most in ((0.5, 140, 160), (0.05, 55, 80), (0.005, 20, 35)):
    fallen, right = swing(length)
    free, _ = swing(length, friction=0.0)
    print(f"a pendulum of {1000 * length:.0f} mm: {fallen:.0f} degrees, MuJoCo {right:.0f}, with set_friction(0) {free:.0f}")
    assert least < fallen < most and right > 179 and free > 175
END
"$place/bin/python" "$place/try.py" "$place"
