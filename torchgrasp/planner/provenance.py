"""Where grasps come from: hashes, names, frames and units, which travel with them as text."""

import hashlib

from torchgrasp.hand.hand import Hand
from torchgrasp.specs import ContactSpec
from torchgrasp.values import PointCloud


def digest(cloud: PointCloud) -> str:
    """Return the SHA-256 of the points, by which results name their input."""
    return hashlib.sha256(cloud.points.detach().cpu().double().contiguous().numpy().tobytes()).hexdigest()


def metadata(cloud: PointCloud, hand: Hand, spec: ContactSpec) -> dict[str, str]:
    """Return the origin and the units of grasps, for their file."""
    return {
        "hand": hand.name,
        "hand_sha256": hand.source.sha256,
        "cloud_sha256": digest(cloud),
        "joint_names": ",".join(hand.joint_names),
        "finger_names": ",".join(hand.finger_names),
        "frames": "obj: the frame of the cloud; hand: the base link of the hand's URDF; a_from_b maps b into a",
        "units": "metre, radian",
        "friction": f"{spec.friction:g}",
        "planned_friction": f"{spec.planned_friction:g}",
        "table": "none" if spec.plane is None else spec.plane.describe(),
    }
