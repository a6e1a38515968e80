#!/usr/bin/env bash
# SAPIEN: get_link_jacobian's help says "local: True for world(spatial) frame; False for link(body) frame"; it is the reverse.
# Nor is the default (False) the link's velocity along the world's axes: its first rows are of the point at the base's origin.
# Packages: sapien 3.0.3, pin 4.1.0, transforms3d 0.4.2, numpy 2.4.6, scipy 1.17.1; Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check sapien==3.0.3 pin==4.1.0 transforms3d==0.4.2 \
    numpy==2.4.6 scipy==1.17.1
cat > "$place/try.py" << 'END'
import sys

import numpy as np
import sapien
from scipy.spatial.transform import Rotation

body = '<inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
joint = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><origin xyz="{3}"/><axis xyz="{4}"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>"""
file = f"{sys.argv[1]}/finger.urdf"
with open(file, "w") as stream:
    stream.write(
        f'<robot name="finger"><link name="palm">{body}</link><link name="first">{body}</link><link name="last">{body}</link>'
        + joint.format("abduction", "palm", "first", "0.3 0 0", "0 0 1")
        + joint.format("flexion", "first", "last", "0.1 0 0", "0 1 0")
        + "</robot>"
    )
loader = sapien.Scene([sapien.physx.PhysxCpuSystem()]).create_urdf_loader()
loader.fix_root_link = True
hand = loader.load(file)
index = [link.name for link in hand.links].index("last")
model = hand.create_pinocchio_model()
q = np.array([0.5, 0.8])
model.compute_full_jacobian(q)

# by hand: the last link sits 0.1 m beyond the abduction's axis, which passes through (0.3, 0, 0)
turn = Rotation.from_euler("ZY", q).as_matrix()
point = np.array([0.3 + 0.1 * np.cos(q[0]), 0.1 * np.sin(q[0]), 0])
axes = np.array([[0, 0, 1], [-np.sin(q[0]), np.cos(q[0]), 0]])  # in the world
at = np.array([[0.3, 0, 0], point])
ways = {
    "the link's origin, along the world's axes": np.vstack([np.cross(axes, point - at).T, axes.T]),
    "the base's origin, along the world's axes": np.vstack([np.cross(axes, -at).T, axes.T]),
    "the link's origin, along the link's axes": np.vstack([turn.T @ np.cross(axes, point - at).T, turn.T @ axes.T]),
}
model.compute_forward_kinematics(q)
assert np.allclose(model.get_link_pose(index).p, point, atol=1e-6)

help_text = model.get_link_jacobian.__doc__
print("sapien", sapien.__version__)
print("its help:", next(line.strip() for line in help_text.splitlines() if "local:" in line))
found = {}
for local in (True, False):
    given = model.get_link_jacobian(index, local=local)
    (found[local],) = (name for name, jacobian in ways.items() if np.allclose(given, jacobian, atol=1e-6))
    off = np.abs(given[:3] - ways["the link's origin, along the world's axes"][:3]).max()
    print(f"local={local}: {found[local]}; {off:.2f} m/rad off the link's velocity in the world")
assert "local: True for world(spatial) frame; False for link(body) frame" in help_text
assert found[True] == "the link's origin, along the link's axes"
assert found[False] == "the base's origin, along the world's axes"
assert np.allclose(model.compute_single_link_local_jacobian(q, index), ways[found[True]], atol=1e-6)
END
"$place/bin/python" "$place/try.py" "$place"
