"""Both simulators against statics: weights, wrenches, drive torques, the friction cone, torsion, forces, repeats."""

import dataclasses
import functools
import hashlib
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.common import Row
from torchgrasp import (
    ContactSpec,
    Grasps,
    Hand,
    Status,
    TrialSpec,
    close_hand,
    load_hand,
    load_object,
    plan_grasps,
)
from torchgrasp.control.holding import ForceHold
from torchgrasp.evaluation.closing import GraspTrial, TrialDriver
from torchgrasp.hand.hand import Actuator
from torchgrasp.jobs import run_tasks
from torchgrasp.sim.mjcf import OBJECT
from torchgrasp.sim.mujoco_scene import MujocoScene
from torchgrasp.sim.sapien_scene import SapienScene
from torchgrasp.sim.scene import Scene, open_scene
from torchgrasp.sim.scene_spec import SceneSpec

SIMULATORS = ("sapien", "mujoco")
FRICTION, PUSH, SIZE, CONE = 0.8, 5.0, 0.05, 0.02
"""Coefficient of friction, force [N] of a finger of the pincer, edge of its cube [m], tolerance of the cone."""

FORCES = (0.5, 1.0, 2.0)
"""Normal forces [N] of the strongest finger that the controller's loop is asked for."""

BODY = """<inertial><mass value="0.1"/><inertia ixx="1e-5" ixy="0" ixz="0" iyy="1e-5" iyz="0" izz="1e-5"/></inertial>"""
FINGER = """<link name="t{k}">{body}<collision><geometry><sphere radius="0.01"/></geometry></collision></link>
  <joint name="j{k}" type="prismatic"><parent link="palm"/><child link="t{k}"/><origin xyz="{x} {y} 0"/>
  <axis xyz="{axis} 0 0"/><limit lower="-0.1" upper="0.1" effort="50" velocity="1"/></joint>"""
STIFFNESS = 2e3
"""Of the pincer's fingers [N/m]."""


def pincer(simulator: str, patch: float) -> tuple[Scene, float]:
    """Return a cube of 1 kg in the air between two spheres that press on it along x, and their forces' sum [N]."""
    reach = SIZE / 2 + 0.01
    fingers = [(0, reach, 0.0, -1), (1, -reach, 0.0, 1), (2, reach, 1.0, -1)]
    links = "".join(FINGER.format(k=k, x=x, y=y, axis=axis, body=BODY) for k, x, y, axis in fingers)
    cube = trimesh.creation.box((SIZE,) * 3)
    names = ("j0", "j1", "j2")
    drives = dict.fromkeys(names, Actuator(effort=50.0, velocity=1.0, kp=STIFFNESS, kd=20.0))
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(folder) / "hand.urdf"
        urdf.write_text(f'<robot name="pincer"><link name="palm">{BODY}</link>{links}</robot>')
        setup = SceneSpec(
            urdf, np.eye(4), dict.fromkeys(names, 0.0), drives, ("t0", "t1", "t2"), cube, [cube],
            mass=1.0, friction=FRICTION, gravity=0.0, table=False, patch=patch,
        )  # fmt: skip
        scene = open_scene(setup, simulator)
    scene.drive(np.array([0.0 if name == "j2" else PUSH / STIFFNESS for name in scene.joint_names]))
    for _ in range(250):
        seen = scene.step()
    return scene, float(np.linalg.norm(seen.impulse, axis=-1).sum() / scene.timestep)


def sliding_friction(simulator: str, angle: float) -> float:
    """Return the coefficient of friction by which a cube resists a pull across the fingers that makes it slide."""
    scene, normal = pincer(simulator, patch=0.0)
    direction = np.array([0.0, math.cos(angle), math.sin(angle)])
    pull = 1.1 * FRICTION * normal
    scene.pull(pull * direction)
    found, normal = acceleration(scene, lambda pose: float(direction @ pose[:3, 3]))
    return (pull - found) / normal


def torsional_friction(simulator: str, patch: float) -> float:
    """Return torsional friction over friction and normal force [m]: the radius of the patch that resists a torque."""
    scene, normal = pincer(simulator, patch)
    torque, inertia = 1.1 * FRICTION * patch * normal, SIZE**2 / 6
    scene.pull(np.zeros(3), np.array([torque, 0.0, 0.0]))
    found, normal = acceleration(scene, lambda pose: math.atan2(pose[2, 1], pose[1, 1]))
    return (torque - inertia * found) / (FRICTION * normal)


def acceleration(scene: Scene, place: Callable[[np.ndarray], float]) -> tuple[float, float]:
    """Return the second difference of a coordinate of the object's pose in 0.12 s, and the mean normal force [N]."""
    seen, normal = [], 0.0
    for _ in range(3):
        for _ in range(20):
            normal += float(np.linalg.norm(scene.step().impulse, axis=-1).sum()) / (60 * scene.timestep)
        seen.append(place(scene.object_pose()))
    return (seen[2] - 2 * seen[1] + seen[0]) / (20 * scene.timestep) ** 2, normal


def creep(simulator: str, angle: float) -> float:
    """Return how far [m] the cube moves in half a second under a pull of 0.02 normal forces less than the cone."""
    scene, normal = pincer(simulator, patch=0.0)
    scene.pull((FRICTION - CONE) * normal * np.array([0.0, math.cos(angle), math.sin(angle)]))
    for _ in range(250):
        scene.step()
    return float(np.linalg.norm(scene.object_pose()[:3, 3]))


def resting_force(simulator: str, hand: Hand) -> float:
    """Return the error of the table's force on a box that stands on it, as a share of its weight."""
    box = trimesh.creation.box((0.06, 0.08, 0.1))
    pose, joints = np.eye(4), hand.expand(0.5 * (hand.lower + hand.upper))
    pose[2, 3] = 1.0
    start = {name: float(q) for name, q in joints.items()}
    setup = SceneSpec(hand.urdf_path, pose, start, hand.actuators, tuple(hand.tips.links), box, [box], 0.36)
    scene = open_scene(setup, simulator)
    forces = []
    for _ in range(200):
        scene.step()
        forces.append(support(scene))
    return abs(float(np.mean(forces[100:])) / (0.36 * setup.gravity) - 1)


def support(scene: Scene) -> float:
    """Return the force [N] with which all contacts hold up the object."""
    if isinstance(scene, MujocoScene):
        return float(scene.data.joint(OBJECT).qfrc_constraint[2])
    assert isinstance(scene, SapienScene)
    impulse = sum(np.asarray(p.impulse) for c in scene.system.get_contacts() for p in c.points)
    return abs(float(np.asarray(impulse)[2])) / scene.timestep


@dataclasses.dataclass(frozen=True)
class Held:
    """A grasp that the library's controller closed and lifted: means over the last half second.

    `weight` is the error of the fingertips' forces against the object's weight, as a share of it; `torque` [N m] the
    largest difference of a drive's torque and J^T f, of joints that are at no stop; `force` the normal forces' sum over
    what was asked for.
    """

    weight: float
    torque: float
    force: float


def hold(
    hand: Hand, grasp: Grasps, mesh: trimesh.Trimesh, simulator: str, force: float, seed: int | None, lift: bool = True
) -> Held:
    """Close a hand with the uncertainty-aware controller, lift and hold, fingertips touching in points (no patch)."""
    mass, noise = 0.1 if lift else 0.02, seed is not None
    spec = TrialSpec(force=force, mass=mass, patch=0.0, approach=0.0, noise=noise, simulator=simulator)
    run = TrialDriver(GraspTrial(hand, grasp, mesh, seed or 0), spec).open()
    scene, robot, controller = run.scene, run.robot, run.controller
    for _ in run.close():
        pass
    reference, names = robot.reference, hand.tree.joint_names
    order = [scene.joint_names.index(name) for name in names]
    effort = np.array([hand.actuators[name].effort for name in names])
    lower, upper = (reference.expand(limit).numpy() for limit in (reference.hand.lower, reference.hand.upper))
    middle, reach = (lower + upper) / 2, (upper - lower) / 2 - 2e-3  # at a stop the stop carries part of the load
    sums, torques, pressed = [], [], []
    for k in range(400):
        scene.lift(0.1 * min(k / 100, 1.0) * lift)
        run.step()
        if k < 350:
            continue
        contacts = scene.step()
        points, joints = contacts.moment / contacts.weight[:, None], scene.joints()[order]
        from_tips = np.einsum("cij,ci->j", scene.jacobian(points), contacts.force)[order]
        driven = np.clip(reference.kp.numpy() * (controller.targets.joints.numpy() - joints), -effort, effort)
        sums.append(contacts.force.sum(0))
        torques.append(np.where(np.abs(joints - middle) < reach, driven - from_tips, 0.0))
        pressed.append(robot.force.sum())
    weight = np.array([0.0, 0.0, mass * spec.gravity])
    assert isinstance(controller.hold, ForceHold)
    return Held(
        float(np.linalg.norm(np.mean(sums, 0) - weight) / weight[2]),
        float(np.abs(np.mean(torques, 0)).max()),
        float(np.mean(pressed)) / controller.hold.strength,
    )


def digest(name: str, simulator: str) -> str:
    """Return the SHA-256 of every number of a trial on the project's cylinder."""
    hand, grasp, mesh, parts = planned(name)
    result = close_hand(grasp, hand, mesh, TrialSpec(simulator=simulator, hold_time=0.2), seed=3, parts=parts)
    record = (result.forces, result.object_pose, result.hand_pose, result.joints)
    return hashlib.sha256(b"".join(x.numpy().tobytes() for x in record)).hexdigest()


@functools.lru_cache
def planned(name: str) -> tuple[Hand, Grasps, trimesh.Trimesh, list[trimesh.Trimesh]]:
    """Return a hand and its best grasp of the project's cylinder from one view."""
    hand, given = load_hand(name), load_object("cylinder")
    grasps = plan_grasps(given.view, hand, ContactSpec(table=0.0), starts=200)
    return hand, grasps[grasps.status == Status.OK][0], given.mesh, given.parts


def bench_statics() -> list[Row]:
    """Check both simulators, with both hands where a hand is in it."""
    return [row for simulator in SIMULATORS for row in check_rows(simulator)]


def check_rows(simulator: str) -> list[Row]:
    """Return the rows of one simulator."""
    names, angles = ("allegro", "barrett"), [math.radians(a) for a in (0.0, 22.5, 45.0)]
    mu = [sliding_friction(simulator, angle) for angle in angles]
    crept = [creep(simulator, angle) for angle in angles]
    patches = {r: torsional_friction(simulator, r) for r in (0.003, 0.005, 0.02 / 0.6)}
    held = [hold(*planned(name)[:3], simulator, 4.0, None) for name in names]
    still, noisy = (
        [hold(*planned(name)[:3], simulator, force, seed, lift=False).force for name in names for force in FORCES]
        for seed in (None, 0)
    )
    repeats = [digest(name, simulator) == digest(name, simulator) for name in names]
    tasks = [(name, simulator) for name in names]
    elsewhere = [list(run_tasks(digest, tasks, workers=2)) == [digest(*task) for task in tasks]]
    return [
        limit(f"{simulator}: resting force", max(resting_force(simulator, load_hand(n)) for n in names), 0.005, 1, "%"),
        limit(f"{simulator}: sum of tip forces against the weight", max(h.weight for h in held), 0.01, 1, "%"),
        limit(f"{simulator}: drive torque against J^T f", max(h.torque for h in held), 0.005, 1, "N m"),
        limit(f"{simulator}: friction cone at 0, 22.5, 45 degrees", max(abs(m - FRICTION) for m in mu), CONE, 1, ""),
        limit(f"{simulator}: creep in 0.5 s, {CONE} inside the cone", max(crept), None, 1e3, "mm"),
        limit(f"{simulator}: torsion of a patch", max(abs(f / r - 1) for r, f in patches.items()), 0.02, 1, "%"),
        limit(f"{simulator}: forces of 0.5, 1, 2 N", max(abs(f - 1) for f in still), 0.05, 1, "%"),
        limit(f"{simulator}: forces of 0.5, 1, 2 N, noise", max(abs(f - 1) for f in noisy), 0.1, 1, "%"),
        Row(
            f"{simulator}: the same bits, in one process and across two",
            "equal",
            f"{sum(repeats)} of {len(repeats)} and {sum(elsewhere)} of {len(elsewhere)}",
            all(repeats + elsewhere),
            {},
        ),
    ]


def limit(what: str, found: float, most: float | None, scale: float, unit: str) -> Row:
    """Return the row of a number that must not exceed a bar."""

    def text(x: float) -> str:
        return f"{x:.2%}" if unit == "%" else f"{scale * x:.4f} {unit}".strip()

    bar = "-" if most is None else f"<= {text(most)}"
    return Row(what, bar, text(found), None if most is None else found <= most, {"value": found})
