#!/usr/bin/env bash
# pytorch-kinematics: Transform3d(rot=(r, p, y)) turns otherwise than the URDF reader of the same package by the same rpy.
# The first turns by Rx Ry Rz, the URDF by Rz Ry Rx: 0.3, 0.4, 0.5 rad lead to frames that are 0.27 rad apart.
# Packages: pytorch-kinematics 0.10.0, torch 2.13.0 (any build), numpy 2.4.6, scipy 1.17.1; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check pytorch-kinematics==0.10.0 torch==2.13.0 \
    numpy==2.4.6 scipy==1.17.1
cat > "$place/try.py" << 'END'
from importlib.metadata import version

import numpy as np
import pytorch_kinematics as pk
import torch
from scipy.spatial.transform import Rotation

rpy = [0.3, 0.4, 0.5]
urdf = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="fixed">
<parent link="a"/><child link="b"/><origin rpy="0.3 0.4 0.5"/></joint></robot>"""
chain = pk.build_chain_from_urdf(urdf)
read = chain.forward_kinematics(torch.zeros(chain.n_joints))["b"].get_matrix()[0, :3, :3].numpy()
made = pk.Transform3d(rot=rpy).get_matrix()[0, :3, :3].numpy()
apart = float(Rotation.from_matrix(read.T @ made).magnitude())
print("pytorch-kinematics", version("pytorch-kinematics"))
print(f"the URDF's frame and Transform3d(rot=rpy) are {apart:.3f} rad apart")
assert np.allclose(read, Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-6)  # about fixed axes
assert np.allclose(made, Rotation.from_euler("XYZ", rpy).as_matrix(), atol=1e-6)  # about moved axes
assert apart > 0.1
END
"$place/bin/python" "$place/try.py"
