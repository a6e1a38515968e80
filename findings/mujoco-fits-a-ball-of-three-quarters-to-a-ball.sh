#!/usr/bin/env bash
# MuJoCo: a sphere fitted to the mesh of a sphere (type="sphere" mesh="...") has 77 % of its radius and 46 % of its mass.
# A cylinder fitted to a cylinder has 87 % of its radius, a capsule 84 %, and is 5 % too long. No warning.
# By default the fit is to the box of the same inertia, as the documentation says; but half its sides become the radii. That is
# exact for boxes alone: the box of a sphere has half sides of sqrt(3/5) r. So a finger touches a ball of 30 mm radius 7 mm
# too late. With <compiler fitaabb="true"/> all sizes are right.
# Packages: mujoco 3.17.0 (4.0.0 does the same), numpy 2.4.6; Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
cat > "$place/try.py" << 'END'
import itertools

import mujoco
import numpy as np

RADIUS, HALF = 0.03, 0.05  # of round bodies, and half a length [m]
turns = np.linspace(0, 2 * np.pi, 128, endpoint=False)
rise = np.linspace(-np.pi / 2, np.pi / 2, 64)  # of a ball's rings; an even count, so that none is on the equator
ball = np.array([(np.cos(a) * np.cos(t), np.cos(a) * np.sin(t), np.sin(a)) for a in rise[1:-1] for t in turns])
ball = RADIUS * np.vstack([ball, [(0, 0, -1), (0, 0, 1)]])
ring = RADIUS * np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)
up = np.array([0, 0, HALF])
corners = {
    "box": np.array(list(itertools.product((-0.02, 0.02), (-RADIUS, RADIUS), (-HALF, HALF)))),
    "cylinder": np.vstack([ring - up, ring + up]),
    "capsule": np.vstack([np.where(ball[:, 2:] > 0, ball + up, ball - up), ring - up, ring + up]),
    "ellipsoid": ball * [2 / 3, 1, 4 / 3],
    "sphere": ball,
}
true = {
    "box": (0.02, RADIUS, HALF),
    "cylinder": (RADIUS, HALF, 0),
    "capsule": (RADIUS, HALF, 0),
    "ellipsoid": (2 / 3 * RADIUS, RADIUS, 4 / 3 * RADIUS),
    "sphere": (RADIUS, 0, 0),
}
slim, round_box = np.sqrt(3 / 5), np.sqrt(3) / 2  # half sides of the box of a ball and of a disc, by the radius


def fit(kind, aabb):
    """Return the fitted sizes, and the mass as a share of that of the mesh."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler fitaabb="{aabb}"/><asset><mesh name="m" vertex="{" ".join(map(str, corners[kind].ravel()))}"/></asset>'
        f'<worldbody><body><geom type="{kind}" mesh="m"/></body><body><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    return model.geom_size[0], model.body_mass[1] / model.body_mass[2]


print("mujoco", mujoco.__version__)
found = {}
for kind, size in true.items():
    size = np.array(size)
    fitted, mass = fit(kind, "false")
    right, right_mass = fit(kind, "true")
    found[kind] = fitted, mass
    print(
        f"{kind}: sizes {np.round(1000 * size, 1)} mm, fitted {np.round(1000 * fitted, 1)} mm with {100 * mass:.0f} % of the mass; "
        f"with fitaabb {np.round(1000 * right, 1)} mm, {100 * right_mass:.0f} %"
    )
    assert np.allclose(right, size, rtol=2e-3) and abs(right_mass - 1) < 5e-3
assert np.allclose(found["box"][0], true["box"], rtol=1e-3)
assert np.allclose(found["sphere"][0][0], slim * RADIUS, rtol=2e-3) and abs(found["sphere"][1] - slim**3) < 5e-3
assert np.allclose(found["ellipsoid"][0], slim * np.array(true["ellipsoid"]), rtol=2e-3)
assert np.allclose(found["cylinder"][0][:2], (round_box * RADIUS, HALF), rtol=2e-3) and abs(found["cylinder"][1] - 0.75) < 5e-3
radius, half, _ = found["capsule"][0]
assert abs(radius / RADIUS - 0.84) < 0.005 and abs((radius + half) / (RADIUS + HALF) - 1.045) < 0.005
END
for version in 4.0.0 3.17.0; do
    "$place/bin/python" -m pip install -qq --disable-pip-version-check mujoco==$version numpy==2.4.6
    "$place/bin/python" "$place/try.py"
done
