#!/usr/bin/env bash
# A URDF joint that mimics a mimic joint: yourdfpy leaves it at its offset, Pinocchio refuses it, MuJoCo couples it.
# The first joint turns by 0.3 rad, the second by twice as much, the third by half of the second: the last link is at 1.2 rad.
# yourdfpy's link is at 0.9 rad, with a line in the log; Pinocchio's mimic=True raises a ValueError of a template in C++.
# Packages: yourdfpy 0.0.60, trimesh 5.2.0, pin 4.1.0, mujoco 3.17.0, numpy 2.4.6; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check yourdfpy==0.0.60 trimesh==5.2.0 pin==4.1.0 \
    mujoco==3.17.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import sys
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import yourdfpy

INERTIAL = (
    '<inertial><mass value="0.1"/>'
    '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
)
MIMICS = {1: "", 2: '<mimic joint="j1" multiplier="2"/>', 3: '<mimic joint="j2" multiplier="0.5"/>'}
text = '<link name="l0"/>'
for k, mimic in MIMICS.items():
    text += (
        f'<link name="l{k}">{INERTIAL}</link><joint name="j{k}" type="revolute">'
        f'<parent link="l{k - 1}"/><child link="l{k}"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>'
        f'<limit lower="-3" upper="3" effort="1" velocity="1"/>{mimic}</joint>'
    )
file = Path(sys.argv[1], "chain.urdf")
file.write_text(f'<robot name="chain">{text}</robot>')
for name in ("yourdfpy", "pin", "mujoco"):
    print(name, version(name))

first = 0.3
meant = first + 2 * first + 0.5 * 2 * first
robot = yourdfpy.URDF.load(str(file))
robot.update_cfg([first])
turn = robot.get_transform("l3", "l0")
angle = float(np.arctan2(turn[0, 2], turn[0, 0]))
print(f"meant {meant:.2f} rad, yourdfpy {angle:.2f} rad")
assert abs(angle - 3 * first) < 1e-9

try:
    pinocchio.buildModelFromUrdf(str(file), mimic=True)
    said = ""
except ValueError as error:
    said = str(error)
print("Pinocchio, mimic=True:", " ".join(said.split())[:120])
assert said

model = mujoco.MjModel.from_xml_path(str(file))
pairs = list(zip(model.eq_obj1id.tolist(), model.eq_obj2id.tolist(), model.eq_data[:, 1].tolist()))
print("MuJoCo's equalities (follower, leader, ratio):", pairs)
assert pairs == [(1, 0, 2.0), (2, 1, 0.5)]
END
"$place/bin/python" "$place/try.py" "$place"
