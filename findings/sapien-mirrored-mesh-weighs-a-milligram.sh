#!/usr/bin/env bash
# SAPIEN: a collision mesh mirrored by its scale (1 -1 1), as left hands are made of right ones, weighs 1 mg in place of 90 g.
# So does a link of a URDF without an inertial, and an actor with a density. Its inertia is 1e-6 kg m^2 about each axis, without
# a warning. The contacts are those of the mirrored mesh, so it looks right. Two mirrors (-1 -1 1) keep the mass, and so does
# MuJoCo for one.
# Packages: sapien 3.0.3, mujoco 3.17.0, numpy 2.4.6; Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check sapien==3.0.3 mujoco==3.17.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import sys
import warnings

import mujoco
import numpy as np

warnings.simplefilter("ignore")  # of a missing driver for pictures
import sapien

# a wedge of 100 x 60 x 30 mm: 90 ml, so 90 g at SAPIEN's and MuJoCo's 1000 kg/m^3
corners = [(-50, 0, 0), (50, 0, 0), (-50, 60, 0), (50, 60, 0), (-50, 60, 30), (50, 60, 30)]
faces = [(1, 3, 4), (1, 4, 2), (1, 2, 6), (1, 6, 5), (3, 5, 6), (3, 6, 4), (1, 5, 3), (2, 4, 6)]
lines = [f"v {x / 1000:.3f} {y / 1000:.3f} {z / 1000:.3f}" for x, y, z in corners]
with open(f"{sys.argv[1]}/wedge.obj", "w") as stream:
    stream.write("\n".join(lines + [f"f {a} {b} {c}" for a, b, c in faces]) + "\n")

HEAVY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
URDF = """<robot name="hand"><link name="palm">{0}</link><link name="finger"><collision><geometry>
<mesh filename="wedge.obj" scale="{1}"/></geometry></collision></link><joint name="j" type="revolute"><parent link="palm"/>
<child link="finger"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def weigh(scale):
    """Return the masses [g] of link, actor and MuJoCo's body, the actor's inertia, and the force [N] on the ground."""
    words = " ".join(map(str, scale))
    file = f"{sys.argv[1]}/hand.urdf"
    with open(file, "w") as stream:
        stream.write(URDF.format(HEAVY, words))
    loader = sapien.Scene([sapien.physx.PhysxCpuSystem()]).create_urdf_loader()
    (link,) = [x for x in loader.load(file).links if x.name == "finger"]

    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.timestep = 0.002
    scene.add_ground(0, render=False)
    builder = scene.create_actor_builder()
    builder.add_convex_collision_from_file(f"{sys.argv[1]}/wedge.obj", scale=scale, density=1000)
    actor = builder.build(name="wedge")
    actor.set_pose(sapien.Pose([0, 0, 0.001]))
    body = actor.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
    for _ in range(400):
        scene.step()
    assert abs(actor.pose.p[2]) < 1e-4  # it rests on its flat side
    push = sum(abs(p.impulse[2]) for contact in scene.get_contacts() for p in contact.points) / scene.timestep

    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="m" file="{sys.argv[1]}/wedge.obj" scale="{words}"/></asset><worldbody><body>'
        '<freejoint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    return 1000 * link.mass, 1000 * body.mass, 1000 * model.body_mass[1], np.array(body.inertia), push


print("sapien", sapien.__version__, "mujoco", mujoco.__version__)
for scale in ([1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]):
    link, actor, other, inertia, push = weigh(scale)
    print(
        f"scale {scale}: link {link:.3g} g, actor {actor:.3g} g, MuJoCo {other:.3g} g; inertia {inertia}, "
        f"weight on the ground {push:.3g} N"
    )
    assert np.isclose(other, 90, atol=1e-3)
    if np.prod(scale) > 0:
        assert np.allclose([link, actor], 90, atol=1e-3) and np.isclose(push, 0.883, atol=0.01) and inertia[0] > 2e-5
    else:
        assert np.allclose([link, actor], 1e-3, rtol=1e-3) and push < 1e-4 and np.allclose(inertia, 1e-6, rtol=1e-3, atol=0)
END
"$place/bin/python" "$place/try.py" "$place"
