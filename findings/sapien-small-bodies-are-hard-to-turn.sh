#!/usr/bin/env bash
# SAPIEN: a moment of inertia worked out from shapes is never below 1e-6 kg m^2. A bead of 10 mm, of water's density, has 191
# times the right one. It rolls down a slope 56 times too slowly. A die of 10 mm has 60 times the right one, a ball of 40 mm
# is right. All masses are right, so nothing is seen in free fall, and there is no warning. It holds for actors with a
# density, and for a URDF's links without an inertial. A smaller inertia that is given, to a body or in an <inertial>, is
# kept. The bead then rolls as it should.
# Packages: sapien 3.0.3, mujoco 3.17.0, numpy 2.4.6; Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check sapien==3.0.3 mujoco==3.17.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import itertools
import sys
import warnings

import mujoco
import numpy as np

warnings.simplefilter("ignore")  # of a missing driver for pictures
import sapien

DENSITY = 1000  # [kg/m^3]
GRAVITY = np.array([np.sin(np.deg2rad(5)), 0, -np.cos(np.deg2rad(5))]) * 9.81  # on a slope of 5 degrees [m/s^2]
TIME, STEP = 0.5, 0.001  # [s]
config = sapien.physx.PhysxSceneConfig()
config.gravity = GRAVITY
sapien.physx.set_scene_config(config)
rough = sapien.physx.PhysxMaterial(1, 1, 0)


def make(add):
    """Return the scene, the actor and its body, of the shapes that `add` gives to the builder."""
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.timestep = STEP
    builder = scene.create_actor_builder()
    add(builder)
    actor = builder.build()
    return scene, actor, actor.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)


def compare(add, geom):
    """Return mass and least and greatest inertia of SAPIEN's body, as parts of MuJoCo's."""
    body = make(add)[2]
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body><geom {geom}/></body></worldbody></mujoco>")
    parts = np.sort(body.inertia) / np.sort(model.body_inertia[1])
    return body.mass / model.body_mass[1], parts.min(), parts.max()


def roll(radius, given):
    """Return how far the ball rolls, as a part of 5/14 g sin(slope) t^2, that of a solid ball."""
    scene, actor, body = make(lambda b: b.add_sphere_collision(radius=radius, density=DENSITY, material=rough))
    if given:
        body.inertia = np.full(3, 0.4 * body.mass * radius**2, np.float32)
    scene.add_ground(0, render=False, material=rough)
    actor.set_pose(sapien.Pose([0, 0, radius]))
    for _ in range(round(TIME / STEP)):
        scene.step()
    assert np.isclose(body.linear_velocity[0], radius * body.angular_velocity[1], rtol=0.01)  # it does not slip
    return actor.pose.p[0] / (5 / 14 * GRAVITY[0] * TIME**2)


print("sapien", sapien.__version__, "mujoco", mujoco.__version__)
for size in (0.01, 0.02, 0.04):
    half = size / 2
    file = f"{sys.argv[1]}/cube{1000 * size:.0f}.obj"  # SAPIEN reads a path only once
    corners = list(itertools.product((-half, half), repeat=3))
    faces = "1 2 4,1 4 3,5 7 8,5 8 6,1 5 6,1 6 2,3 4 8,3 8 7,1 3 7,1 7 5,2 6 8,2 8 4"
    with open(file, "w") as stream:
        stream.write("".join(f"v {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in corners))
        stream.write("".join(f"f {face}\n" for face in faces.split(",")))
    box = f'type="box" size="{half} {half} {half}"'
    shapes = {
        "ball": (lambda b: b.add_sphere_collision(radius=half, density=DENSITY), f'type="sphere" size="{half}"'),
        "die": (lambda b: b.add_box_collision(half_size=[half] * 3, density=DENSITY), box),
        "mesh of a die": (lambda b: b.add_convex_collision_from_file(file, density=DENSITY), box),
    }
    for name, (add, geom) in shapes.items():
        mass, least, most = compare(add, geom)
        print(f"{name} of {1000 * size:.0f} mm: mass times {mass:.3f}, inertia times {least:.4g}")
        true = 1000 * size**5 * (np.pi / 60 if name == "ball" else 1 / 6)
        assert np.isclose(mass, 1, rtol=1e-4) and np.isclose(least, most)
        assert np.isclose(least, max(1e-6, true) / true, rtol=1e-3)
    found, right = roll(half, given=False), roll(half, given=True)
    print(f"a ball of {1000 * size:.0f} mm rolls {found:.3f} of the way, with a given inertia {right:.3f}")
    assert np.isclose(right, 1, atol=0.01)
    assert np.isclose(found, {0.01: 0.018, 0.02: 0.412, 0.04: 1}[size], rtol=0.02)

HEAVY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
SHAPE = '<collision><geometry><sphere radius="0.005"/></geometry></collision>'
GIVEN = '<inertial><mass value="0.001"/><inertia ixx="1e-8" iyy="1e-8" izz="1e-8" ixy="0" ixz="0" iyz="0"/></inertial>'
URDF = """<robot name="hand"><link name="palm">{0}</link><link name="tip">{1}</link><joint name="j" type="revolute">
<parent link="palm"/><child link="tip"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""
for name, link, inertia in (("no inertial", SHAPE, 1e-6), ("an inertial of 1e-8 kg m^2", SHAPE + GIVEN, 1e-8)):
    file = f"{sys.argv[1]}/hand.urdf"
    with open(file, "w") as stream:
        stream.write(URDF.format(HEAVY, link))
    loader = sapien.Scene([sapien.physx.PhysxCpuSystem()]).create_urdf_loader()
    (tip,) = [x for x in loader.load(file).links if x.name == "tip"]
    print(f"a URDF's link with {name}: {tip.inertia[0]:.3g} kg m^2")
    assert np.allclose(tip.inertia, inertia, rtol=1e-4, atol=0)
END
"$place/bin/python" "$place/try.py" "$place"
