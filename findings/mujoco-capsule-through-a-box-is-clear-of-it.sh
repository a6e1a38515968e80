#!/usr/bin/env bash
# MuJoCo: a capsule that runs through a box has no contact with it, and mj_geomDistance calls it clear by up to 38 mm.
# The distance is that of the capsule's nearer end. Where a capsule longer than the box is 15 mm deep in its side, the depth
# is the radius, 10 mm, and points along the capsule. Where its axis is outside the box, all is right. With the same box given
# as a mesh of eight corners, MuJoCo finds the contacts and coal's depth.
# Packages: mujoco 3.17.0 (4.0.0 does the same), coal 3.0.3, numpy 2.4.6; Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
cat > "$place/try.py" << 'END'
import itertools

import coal
import mujoco
import numpy as np

RADIUS, HALF = 0.01, 0.05  # of the capsule [m]
cases = {
    "plate of 4 mm, upright": ((0.08, 0.08, 0.002), 0, (0.01, 0, 0)),
    "plate of 4 mm, leaning by 45 degrees": ((0.08, 0.08, 0.002), 45, (0.01, 0, 0)),
    "carton of 60 mm, upright": ((0.05, 0.04, 0.03), 0, (0.01, 0, 0)),
    "carton, 15 mm into its side": ((0.05, 0.04, 0.03), 0, (0.045, 0, 0)),
    "carton, 1 mm into its side": ((0.05, 0.04, 0.03), 0, (0.059, 0, 0)),
}
found = {}
print("mujoco", mujoco.__version__, "coal", coal.__version__)
for name, (half, lean, at) in cases.items():
    corners = np.array(list(itertools.product(*[(-a, a) for a in half]))).ravel()
    shapes = {
        "box": f'type="box" size="{half[0]} {half[1]} {half[2]}"',
        "mesh": 'type="mesh" mesh="m"',
    }
    row = {}
    for kind, shape in shapes.items():
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><asset><mesh name="m" vertex="{" ".join(map(str, corners))}"/></asset><worldbody><geom {shape}/>'
            f'<body pos="{at[0]} {at[1]} {at[2]}" euler="{lean} 0 0"><freejoint/>'
            f'<geom type="capsule" size="{RADIUS} {HALF}"/></body></worldbody></mujoco>'
        )
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        ends = np.zeros(6)
        row[kind] = 1000 * mujoco.mj_geomDistance(model, data, 0, 1, 1.0, ends), data.ncon, ends[3:] - ends[:3]
    pose = coal.Transform3s(data.geom_xmat[1].reshape(3, 3).copy(), data.geom_xpos[1].copy())
    ask = coal.DistanceRequest()
    ask.enable_signed_distance = True
    body = coal.Box(*(2 * np.array(half)))
    true = 1000 * coal.distance(body, coal.Transform3s(), coal.Capsule(RADIUS, 2 * HALF), pose, ask, coal.DistanceResult())
    found[name] = [*row["box"][:2], *row["mesh"][:2], true]
    print(
        f"{name}: box {row['box'][0]:+.1f} mm and {row['box'][1]} contacts, "
        f"mesh {row['mesh'][0]:+.1f} mm and {row['mesh'][1]} contacts, coal {true:+.1f} mm"
    )
    assert row["mesh"][1] > 0 and abs(row["mesh"][0] - true) < 0.1
    if name.endswith("15 mm into its side"):  # pushed out along z, where the capsule is 120 mm long
        assert abs(row["box"][2][2]) > 0.009 and abs(row["box"][2][0]) < 1e-9
expected = {
    "plate of 4 mm, upright": (38, 0, -62),
    "plate of 4 mm, leaning by 45 degrees": (23.36, 0, -47.36),
    "carton of 60 mm, upright": (10, 0, -50),
    "carton, 15 mm into its side": (-10, 1, -15),
    "carton, 1 mm into its side": (-1, 1, -1),  # right
}
for name, (distance, contacts, true) in expected.items():
    box, box_contacts, _, _, seen = found[name]
    assert abs(box - distance) < 0.1 and box_contacts == contacts and abs(seen - true) < 0.1, (name, found[name])
END
for version in 4.0.0 3.17.0; do
    "$place/bin/python" -m pip install -qq --disable-pip-version-check mujoco==$version coal==3.0.3 numpy==2.4.6
    "$place/bin/python" "$place/try.py"
done
