"""Which objects no planned grasp can hold: a linear programme proves it at the contacts on the true
surface.

Each planned contact is moved along its normal to the true surface. The programme looks for forces
that balance weight and push within wider friction cones and within the hand's limits, so that a
failure is a proof.
"""

import math

import numpy as np
import torch
import trimesh
from paper.trials import Subject, TableSpec, subjects
from torch import Tensor

from benchmarks.close.campaign import keep, plan_view, read_solid, run_all, table_spec
from benchmarks.close.holding import EDGES, least_grip
from benchmarks.common import Options, Row, bench
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.hand.load import hand_of, load_hand
from torchgrasp.values.planning import Grasps

TABLE_LIFT = PROTOCOLS["table-lift"].trial
PUSH = 2.5  # size of the push [N]
PUSHES = PUSH * torch.cat([torch.eye(3), -torch.eye(3)]).double()
"""Pushes [N] that all have to be held."""


@bench("close/statics", objects=True)
def statics(o: Options) -> list[Row]:
    """Count the objects that no planned grasp can hold, at rest and under a push."""
    spec = table_spec(o)
    rows = list[Row]()
    for hand in spec.hands:
        named = subjects(spec)
        found = list(
            run_all(judge_object, [(spec, subject, hand) for subject in named], spec.workers)
        )
        for k, what in enumerate(("weight", f"weight and {PUSH:g} N")):
            lost = [
                subject.label
                for subject, some in zip(named, found, strict=True)
                if not any(x[k] for x in some)
            ]
            best = sum(bool(some) and some[0][k] for some in found)
            text = f"best grasp can on {best} of {len(found)}; no grasp can on {len(lost)}: {', '.join(lost) or 'none'}"
            rows.append(Row(f"{hand}, {what}", "-", text, None, {"no_grasp": lost, "best": best}))
    return rows


def judge_object(spec: TableSpec, subject: Subject, hand: str) -> list[tuple[bool, bool]]:
    """Return for each planned grasp whether its contacts can hold the object at rest, and under all
    pushes.
    """

    def judge() -> list[tuple[bool, bool]]:
        grasps = plan_view(spec, subject, hand, TABLE_LIFT.friction)
        return [can_hold(grasp, read_solid(subject).mesh, hand) for grasp in grasps]

    return keep(
        spec.kept("statics", f"{hand}_{subject.label}", spec.grasps).with_suffix(".json"), judge
    )


def can_hold(grasp: Grasps, mesh: trimesh.Trimesh, hand_name: str) -> tuple[bool, bool]:
    """Return whether a grasp's contacts on the true surface can hold the object at rest, and under
    all pushes.
    """
    hand = hand_of(grasp, load_hand(hand_name)).to("cpu", torch.float64)
    pose = grasp.obj_from_hand.double()
    points, normals = map(torch.from_numpy, true_contacts(grasp, mesh))
    jacobian = hand.jacobian(grasp.joints.double(), apply(inverse(pose), points[None]))[0]
    effort = torch.tensor(
        [hand.actuators[name].effort for name in hand.tree.joint_names], dtype=torch.float64
    )
    torques = (pose[0, :3, :3] @ jacobian).mT / (hand.actuated.coupling.abs().T @ effort)[:, None]
    arm = torch.from_numpy(np.array(mesh.center_mass)) - points.mean(0)
    trial = TABLE_LIFT
    wider = trial.friction / math.cos(
        math.pi / EDGES
    )  # its cone with flat sides is around the round one

    def holds(push: Tensor) -> bool:
        force = -torch.tensor([0.0, 0.0, -trial.mass * trial.gravity], dtype=torch.float64) - push
        load = torch.cat([force, torch.linalg.cross(arm, force)])
        return least_grip(points, normals, load, wider, torques, trial.patch) is not None

    at_rest = holds(0 * PUSHES[0])
    return at_rest, at_rest and all(map(holds, PUSHES))


def true_contacts(grasp: Grasps, mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Return points [m] and outward normals where the lines of the contacts' normals first meet the
    true surface.

    A line that misses the surface gives the nearest point of the surface.
    """
    far = 0.05  # [m] outside the planned contact
    planned, outward = (
        x[0].double().numpy() for x in (grasp.contacts.points, grasp.contacts.normals)
    )
    points, _, triangles = mesh.nearest.on_surface(planned)
    hits, rays, faces = mesh.ray.intersects_location(
        planned + far * outward, -outward, multiple_hits=False
    )
    points = np.array(points)
    triangles = np.array(triangles)
    points[rays] = hits
    triangles[rays] = faces
    return points, np.array(mesh.face_normals[triangles])
