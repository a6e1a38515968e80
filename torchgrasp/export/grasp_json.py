"""Grasps as plain JSON: three postures of named joints, with forces, torques, frames and units.

DexGraspBench's own .npy is a pickled dictionary. It could run code when it is read, so it is not written.
"""

from typing import Annotated

from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import Positive, Range, checked
from torchgrasp.control.forces import squeeze
from torchgrasp.control.paper.closings import POSE_TIME
from torchgrasp.errors import Status
from torchgrasp.files import format_json
from torchgrasp.geometry.frames import rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.ik.motion import APPROACH_DISTANCE
from torchgrasp.values import Grasps

CONVENTIONS = {
    "units": {"length": "m", "angle": "rad", "force": "N", "torque": "N m", "stiffness": "N m/rad", "time": "s"},
    "frames": {
        "object": "the frame of the cloud that the grasp was planned on",
        "hand": "the root link of the hand's URDF",
    },
    "pose": "position p and unit quaternion (w, x, y, z) of the hand in the object's frame: x_object = R x_hand + p",
    "approach": "unit direction in the object's frame in which the hand comes to its pose, opened, by the distance",
    "joints": "by the names of the hand's URDF, all that move: actuated, coupled and parked",
    "squeeze": "targets of position-controlled joints: stiffness (squeeze - grasp) = torque = J^T force",
    "force": "of the fingertip on the object at its contact, in the object's frame",
}
"""Meaning of the numbers; the file contains it."""


@checked
def format_grasps(
    hand: Hand, grasps: Grasps, force: Annotated[float, Range(0.01, 100.0)] = 4.0, kp: Positive | None = None
) -> str:
    """Return grasps as JSON, with `CONVENTIONS`.

    The hand comes to "pose" along "approach" in its "pregrasp" posture. It closes to "grasp" in the time given.
    In the same time again it presses towards "squeeze". All joints move evenly. The strongest finger presses with a
    normal force of `force` [N]. `kp` is the stiffness of the robot's own position control [N m/rad]; None: the hand's.

    Raises:
        BadArgument: joints of another hand, or a force or stiffness that is not positive.

    >>> import json
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_grasps(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> sorted(json.loads(text)["grasps"][0]["joints"])
    ['grasp', 'pregrasp', 'squeeze']
    """
    hand, grasps = hand.to("cpu"), grasps.to("cpu")
    squeezed, path = squeeze(hand, grasps, force, kp), hand.urdf_path
    forces = rotate(grasps.obj_from_hand.double(), squeezed.forces)
    postures = {"pregrasp": grasps.pregrasp.double(), "grasp": grasps.joints.double(), "squeeze": squeezed.joints}
    named = {name: hand.expand(joints) for name, joints in postures.items()}
    std = grasps.contacts.std_m
    rows = [
        {
            "rank": row,
            "status": Status(int(grasps.status[row])).name,
            "success": float(grasps.success[row]),
            "pose": {"position": pose[:3, 3].tolist(), "quaternion_wxyz": quaternion(pose)},
            "approach": {"direction": grasps.approach[row].tolist(), "distance": APPROACH_DISTANCE},
            "joints": {name: {joint: float(q[row]) for joint, q in all_.items()} for name, all_ in named.items()},
            "torque": dict(zip(hand.joint_names, squeezed.torques[row].tolist(), strict=True)),
            "contacts": [
                {
                    "finger": finger,
                    "link": link,
                    "point": grasps.contacts.points[row, i].tolist(),
                    "normal": grasps.contacts.normals[row, i].tolist(),
                    "force": forces[row, i].tolist(),
                    "std_m": None if std is None else float(std[row, i]),
                    "tip_error": float(grasps.tip_error[row, i]),
                }
                for i, (finger, link) in enumerate(zip(hand.tips.names, hand.tips.links, strict=True))
            ],
            "clearance": float(grasps.clearance[row]),
            "closure_margin": float(grasps.certificate.margin[row]),
        }
        for row, pose in enumerate(grasps.obj_from_hand)
    ]
    content = {
        "format": "torchgrasp grasps",
        "version": 2,  # version 1 had no approach
        **CONVENTIONS,
        "hand": {"name": hand.name, "urdf": path.name, "root": read_urdf(path).root, "sha256": hand.source.sha256},
        "actuated": list(hand.joint_names),
        "stiffness": {name: drive.kp if kp is None else kp for name, drive in hand.actuators.items()},
        "strongest_normal_force": force,
        "time": {"pregrasp": 0.0, "grasp": POSE_TIME, "squeeze": 2 * POSE_TIME},
        "provenance": grasps.meta,
        "grasps": rows,
    }
    return format_json(content)


def quaternion(a_from_b: Float[Tensor, "4 4"]) -> list[float]:
    """Return the rotation of a pose as a unit quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(a_from_b[:3, :3].double().cpu().numpy()).as_quat()
    return [float(q) for q in (w, x, y, z)]
