#!/usr/bin/env bash
# pytorch-kinematics: an import for chains of a URDF also imports matplotlib.pyplot, and mujoco where it is installed.
# Neither computes forward kinematics: matplotlib serves a plot of its inverse kinematics, mujoco its reader of MJCF.
# Packages: pytorch-kinematics 0.10.0, mujoco 3.17.0, matplotlib 3.11.2, torch 2.13.0 (any build), numpy 2.4.6;
# Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check pytorch-kinematics==0.10.0 torch==2.13.0 \
    mujoco==3.17.0 matplotlib==3.11.2 numpy==2.4.6
cat > "$place/try.py" << 'END'
import sys
from importlib.metadata import version

import torch  # what the package needs, imported before

before = {name for name in ("matplotlib.pyplot", "mujoco") if name in sys.modules}
import pytorch_kinematics as pk  # noqa: E402

urdf = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute">
<parent link="a"/><child link="b"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
chain = pk.build_chain_from_urdf(urdf)
chain.forward_kinematics(torch.zeros(chain.n_joints))
brought = {name for name in ("matplotlib.pyplot", "mujoco") if name in sys.modules} - before
print("pytorch-kinematics", version("pytorch-kinematics"))
print("imported beside it:", ", ".join(sorted(brought)) or "nothing")
assert before == set()
assert brought == {"matplotlib.pyplot", "mujoco"}
END
"$place/bin/python" "$place/try.py"
