#!/usr/bin/env bash
# coal (Pinocchio's collision library): once a sphere's centre is inside a cylinder, the depth is always that to the mantle,
# also where an end face is nearer. A fingertip of 8 mm that sinks into a jar's lid of 80 x 4 mm is 7.9 mm deep, and 0.2 mm
# later 38 mm deep. The normal turns by 90 degrees. coal's header speaks of the smallest vector that leads to touching contact.
# Analytic depth, MuJoCo and coal with the same lid as a hull of 128 corners say 8.1 mm. distance and collide share the error.
# Packages: coal 3.0.3, mujoco 3.17.0, numpy 2.4.6; Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check coal==3.0.3 mujoco==3.17.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import coal
import mujoco
import numpy as np

WIDE, HALF, BALL, ASIDE = 0.04, 0.002, 0.008, 0.01  # of the lid, of the ball, and between their axes [m]
model = mujoco.MjModel.from_xml_string(
    f'<mujoco><worldbody><geom type="cylinder" size="{WIDE} {HALF}"/>'
    f'<body><freejoint/><geom type="sphere" size="{BALL}"/></body></worldbody></mujoco>'
)
data = mujoco.MjData(model)
lid, ball, home = coal.Cylinder(WIDE, 2 * HALF), coal.Sphere(BALL), coal.Transform3s()
corners = coal.StdVec_Vec3s()
for turn in np.linspace(0, 2 * np.pi, 64, endpoint=False):
    for z in (-HALF, HALF):
        corners.append(np.array([WIDE * np.cos(turn), WIDE * np.sin(turn), z]))
hull = coal.Convex.convexHull(corners, False, "")


def depth_and_normal(shape, pose):
    ask, answer = coal.DistanceRequest(), coal.DistanceResult()
    ask.enable_signed_distance = True
    return -1000 * coal.distance(shape, home, ball, pose, ask, answer), np.array(answer.normal)


print("coal", coal.__version__, "mujoco", mujoco.__version__)
for height in (0.0095, 0.003, 0.0021, 0.0019, 0.001):
    place = np.array([ASIDE, 0, height])
    pose = coal.Transform3s(np.eye(3), place)
    data.qpos[:] = *place, 1, 0, 0, 0
    mujoco.mj_forward(model, data)
    other = -1000 * mujoco.mj_geomDistance(model, data, 0, 1, 1.0, np.zeros(6))
    through_face, through_mantle = 1000 * (BALL + HALF - height), 1000 * (BALL + WIDE - ASIDE)
    found, normal = depth_and_normal(lid, pose)
    of_hull, _ = depth_and_normal(hull, pose)
    contact = coal.CollisionResult()
    coal.collide(lid, home, ball, pose, coal.CollisionRequest(coal.CONTACT, 1), contact)
    inside = height < HALF
    print(
        f"centre {1000 * (height - HALF):+.1f} mm from the face: analytic {through_face:.1f} mm, MuJoCo {other:.1f} mm, "
        f"coal's hull {of_hull:.1f} mm, coal's cylinder {found:.1f} mm along {np.round(normal, 3) + 0.0}"
    )
    assert np.allclose([other, of_hull], through_face, atol=1e-6)
    assert np.isclose(found, through_mantle if inside else through_face, atol=1e-6)
    assert np.allclose(normal, [1, 0, 0] if inside else [0, 0, 1], atol=1e-6)
    assert np.isclose(-1000 * contact.getContact(0).penetration_depth, found, atol=1e-6)
END
"$place/bin/python" "$place/try.py"
