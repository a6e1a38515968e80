#!/usr/bin/env bash
# SAPIEN: a fingertip that is pushed at the rim of a coaster passes into it. A ball of 12 mm radius moves towards the axis of a
# disc of ten sides, 30 mm in radius and 12 mm high. Its centre is 16 mm over the disc's foot. In 6 of 12 directions PhysX
# reports no contact though the ball is 0.1 to 1 mm inside. With the centre below the rim all is right. The same scene in
# centimetres, with all lengths a hundred times as large, has its contacts in all directions. So has MuJoCo's in metres.
# SAPIEN has no option for PhysX's scale of lengths, which stays one metre.
# Packages: sapien 3.0.3, mujoco 3.17.0, numpy 2.4.6; Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check sapien==3.0.3 mujoco==3.17.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import warnings

import mujoco
import numpy as np

warnings.simplefilter("ignore")  # of a missing driver for pictures
import sapien
from sapien import physx

RADIUS, SIDES, WIDE, HIGH = 0.012, 10, 0.03, 0.012  # of the ball, and of the disc [m]
SPEED, STEP, OFFSET = 0.03, 0.002, 0.002  # [m/s, s, m]
HIGHER, LOWER = 0.016, 0.0095  # heights of the ball's centre [m]
BEGIN, LAST = 0.016, 0.006  # distances of the ball's centre from the rim [m]
turn = 2 * np.pi * np.arange(SIDES) / SIDES
rim = np.c_[WIDE * np.cos(turn), WIDE * np.sin(turn)]
CORNERS = np.r_[np.c_[rim, 0 * turn], np.c_[rim, 0 * turn + HIGH]]


def depth(place):
    """Return the true depth of a ball at `place` in the disc, negative outside; its centre is beside the disc."""
    edges = np.roll(rim, -1, 0) - rim
    share = np.clip(((place[:2] - rim) * edges).sum(1) / (edges**2).sum(1), 0, 1)
    beside = np.linalg.norm(rim + share[:, None] * edges - place[:2], axis=1).min()
    return RADIUS - np.hypot(beside, max(place[2] - HIGH, 0.0))


def places(direction, height):
    """Yield where the ball's centre is in each step."""
    for k in range(round((BEGIN - LAST) / (SPEED * STEP))):
        yield np.append((WIDE + BEGIN - SPEED * STEP * k) * direction, height)


def misses_in_sapien(direction, height, unit):
    """Return whether a ball 0.1 to 1 mm deep has no contact, in a scene with `unit` lengths to the metre."""
    missing = False
    physx.set_scene_config(gravity=np.zeros(3, np.float32))
    physx.set_shape_config(contact_offset=unit * OFFSET, rest_offset=0.0)
    system = physx.PhysxCpuSystem()
    scene = sapien.Scene([system])
    scene.timestep = STEP
    rough = physx.PhysxMaterial(0.8, 0.8, 0)
    disc, ball = physx.PhysxRigidStaticComponent(), physx.PhysxRigidDynamicComponent()
    # cooked from large numbers, as PhysX drops vertices that are near to each other
    disc.attach(physx.PhysxCollisionShapeConvexMesh((100 * CORNERS).astype(np.float32), np.full(3, unit / 100, np.float32), rough))
    ball.attach(physx.PhysxCollisionShapeSphere(unit * RADIUS, rough))
    ball.disable_gravity = True
    entities = [sapien.Entity(), sapien.Entity()]
    for entity, body in zip(entities, (disc, ball), strict=True):
        entity.add_component(body)
        scene.add_entity(entity)
    for place in places(direction, height):
        entities[1].set_pose(sapien.Pose(unit * place))
        ball.linear_velocity = np.zeros(3)
        system.step()
        touches = any(contact.points for contact in system.get_contacts())
        missing |= 1e-4 < depth(place) < 1e-3 and not touches
    return missing


def misses_in_mujoco(direction, height):
    """Return the same of MuJoCo's contacts, in metres."""
    missing = False
    corners = " ".join(f"{x:.9g}" for x in CORNERS.ravel())
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="disc" vertex="{corners}"/></asset><worldbody><body mocap="true" name="ball"><geom size="{RADIUS}"'
        f' margin="{OFFSET}"/></body><body pos="0 0 0"><freejoint/><geom type="mesh" mesh="disc"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    middle = CORNERS.mean(0)  # MuJoCo moves the mesh to its centre
    data.qpos[:3] = 0
    for place in places(direction, height):
        data.mocap_pos[0] = place - middle
        mujoco.mj_forward(model, data)
        missing |= 1e-4 < depth(place) < 1e-3 and not data.ncon
    return missing


missed = {}
for name, find in (
    ("SAPIEN, metres, centre above the rim", lambda u: misses_in_sapien(u, HIGHER, 1)),
    ("SAPIEN, metres, centre below the rim", lambda u: misses_in_sapien(u, LOWER, 1)),
    ("SAPIEN, centimetres, centre above the rim", lambda u: misses_in_sapien(u, HIGHER, 100)),
    ("MuJoCo, metres, centre above the rim", lambda u: misses_in_mujoco(u, HIGHER)),
):
    turns = 0.31 * np.arange(12)
    missed[name] = sum(find(np.array([np.cos(t), np.sin(t)])) for t in turns)
    print(f"{name}: no contact 0.1 to 1 mm inside in {missed[name]} of 12 directions")
assert list(missed.values()) == [6, 0, 0, 0], missed
END
"$place/bin/python" "$place/try.py"
