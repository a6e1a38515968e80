"""A real arm: grasps that a UR5e with an Allegro hand reaches, and the joint trajectory of both.

Here the URDF is made from the published Denavit-Hartenberg parameters, with a cylinder around each
link. A maker's URDF has meshes: `torchgrasp.app.author.clean_arm` replaces them. With the network
and `pip install robot_descriptions`:

    from robot_descriptions import panda_description as found  # or ur5e_description, ...
    file.write_text(clean_arm(found.URDF_PATH, meshes=found.REPOSITORY_PATH))
"""

import math
import tempfile
from pathlib import Path

import torch

from torchgrasp import ContactSpec, load_hand, load_object, plan_grasps
from torchgrasp.arm import load_arm
from torchgrasp.export import format_motion, plan_motion

# name, a, d [m], alpha [rad]; a cylinder's radius, length, centre [m] and pitch [rad]
LINKS = [
    ("shoulder_pan", 0.0, 0.1625, math.pi / 2, 0.06, 0.13, "0 0 0.165", 0.0),
    ("shoulder_lift", -0.425, 0.0, 0.0, 0.06, 0.5, "-0.2125 0 0.138", math.pi / 2),
    ("elbow", -0.3922, 0.0, 0.0, 0.05, 0.45, "-0.1961 0 0.007", math.pi / 2),
    ("wrist_1", 0.0, 0.1333, math.pi / 2, 0.04, 0.11, "0 0 0.125", 0.0),
    ("wrist_2", 0.0, 0.0997, -math.pi / 2, 0.04, 0.1, "0 0 0.09", 0.0),
    ("wrist_3", 0.0, 0.0996, 0.0, 0.04, 0.045, "0 0 0.077", 0.0),
]
urdf = '<robot name="ur5e"><link name="base"/>'
parent = "base"
origin = 'xyz="0 0 0"'
for name, a, d, alpha, radius, length, centre, pitch in LINKS:
    limit = math.pi if name == "elbow" else 2 * math.pi
    urdf += f"""<link name="{name}_link"><collision><origin xyz="{centre}" rpy="0 {pitch} 0"/><geometry>
    <cylinder radius="{radius}" length="{length}"/></geometry></collision></link>
  <joint name="{name}_joint" type="revolute"><parent link="{parent}"/><child link="{name}_link"/><origin {origin}/>
    <axis xyz="0 0 1"/><limit lower="{-limit}" upper="{limit}" effort="150" velocity="3.14"/></joint>"""
    parent = f"{name}_link"
    origin = f'xyz="{a} 0 {d}" rpy="{alpha} 0 0"'
urdf += f"""<link name="tool0"/><joint name="flange" type="fixed"><parent link="{parent}"/><child link="tool0"/>
  <origin {origin}/></joint></robot>"""
file = Path(tempfile.mkdtemp()) / "ur5e.urdf"
file.write_text(urdf)

hand = load_hand("allegro")
base = torch.eye(4)
mount = torch.eye(4)
base[:3, 3] = torch.tensor([-0.55, 0.0, 0.0])  # the arm stands beside the object, on the same table
mount[2, 3] = 0.095  # from the flange to the root of the hand, as your adapter is
arm = load_arm(file, hand, "tool0", obj_from_base=base, tip_from_hand=mount)

grasps = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=50, arm=arm)
best = grasps[0].raise_for_status()
room, manipulability = best.ease[0].tolist()
print(dict(zip(arm.joint_names, best.arm[0].tolist(), strict=True)))
print(f"{best.success[0]:.0%} likely, room {room:.0%}, manipulability {manipulability:.3f}")

motion = plan_motion(arm, hand, best)
for phase, k in motion.phases.items():
    posture = [round(q, 2) for q in motion.positions[0, k, :6].tolist()]
    print(f"{motion.times[k]:.1f} s {phase}: arm at {posture}")
print(len(format_motion(hand, motion).splitlines()), "lines of a trajectory_msgs/JointTrajectory")
