"""Desired forces of the fingers, and the joint targets that exert them with position-controlled
drives.

In shapes, g counts grasps, f fingertips, h actuated joints, and j all joints of the URDF.
"""

import dataclasses
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.foundation.base import Value, count_status, named_tensors, settle
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import Force, Positive, check_dense, is_known
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.geometry.linalg import check_unit_vectors, dot, norm
from torchgrasp.hand.drives import joint_stiffness
from torchgrasp.hand.hand import Hand
from torchgrasp.values.planning import Grasps

CHANGED = 1e-3  # change [m] of a fingertip's place that shows another geometry: above rounding
MOVED = 0.01  # distance [m] of contacts that are no better known ones, but of another frame or unit


@checked
@dataclasses.dataclass(frozen=True)
class PreferredForces(Value):
    """Typical normal forces of stable grasps of three fingers, with their covariance, and spring
    stiffnesses.

    The fingers are in the order of the hand.

    Attributes:
        forces: mean normal force (3,) [N] of each finger.
        covariance: covariance (3, 3) [N^2] of these forces.
        springs: stiffnesses (3,) [N/m] of virtual springs between the fingertips. The springs lie
            along the sides (0, 1), (1, 2) and (2, 0) of the triangle of fingertips.
    """

    forces: Float[Tensor, "3"]
    covariance: Float[Tensor, "3 3"]
    springs: Float[Tensor, "3"]


@runtime_checkable
class ForcePreference(Protocol):
    """The interface of a model that says how hard each finger should press, such as a model of
    stability.

    Several sets of balanced forces may need almost the least friction. Of these, the one nearest to
    the preferred forces is taken.
    """

    def preferred_forces(
        self, tips: Float[Tensor, "3 3"], force: Positive | None = None
    ) -> PreferredForces:
        """Return the preferred normal forces [N] of three fingers, with their covariance, and
        spring stiffnesses.

        Args:
            tips: centres (3, 3) [m] of the fingertips, in any frame.
            force: normal force [N] of the finger that presses hardest; None means that the model
                chooses it.
        """
        ...


def desired_forces(
    points: Float[Tensor, "*b f 3"],
    normals: Float[Tensor, "*b f 3"],
    strongest: float = 4.0,
    preferred: Float[Tensor, "*#b f"] | None = None,
) -> Float[Tensor, "*b f 3"]:
    """Return balanced fingertip forces [N] on the object that need the least friction
    (`least_friction_forces`).

    `points` [m] and outward unit `normals` are those of the f contacts, in any frame. The forces
    are in the same frame. Balanced forces exert no wrench. The friction that they need is the
    largest ratio of a tangential to a normal force. The largest normal force is `strongest` [N].
    `preferred` holds wanted normal forces of the fingers, of which only the ratios count; None
    means equal ones. Where no balanced forces press at every contact, each force is `strongest`
    along the inward normal. `*b` stands for any leading axes.
    """
    balanced = least_friction_forces(points, normals, strongest, preferred)
    return torch.where(torch.isfinite(balanced), balanced, -strongest * normals)


def contacts_in_hand(grasps: Grasps) -> tuple[Float[Tensor, "g f 3"], Float[Tensor, "g f 3"]]:
    """Return the f planned contacts of each of g grasps: first the points [m], then the outward
    unit normals. Their frame is that of the hand's root link.
    """
    hand_from_obj = inverse(grasps.obj_from_hand.double())
    points = apply(hand_from_obj, grasps.contacts.points.double())
    return points, rotate(hand_from_obj, grasps.contacts.normals.double())


class Squeeze(NamedTuple):
    """Joint targets that press on the object in g grasps, with their fingertip forces and joint
    torques.

    `joints` [rad or m] are the targets of the h actuated joints. `forces` [N] are those of the f
    fingertips on the object, in the frame of the hand's root link. `torques` [N m or N] of the
    actuated joints exert these forces.
    """

    joints: Float[Tensor, "g h"]
    forces: Float[Tensor, "g f 3"]
    torques: Float[Tensor, "g h"]


@checked(gradients=True)
def squeeze(hand: Hand, grasps: Grasps, force: Force = 4.0, kp: Positive | None = None) -> Squeeze:
    """Return joint targets with which position-controlled fingers press at their planned contacts.

    The result has three fields, for g grasps, h actuated joints and f fingertips:

    * `joints` (g, h) [rad or m]: targets of the actuated joints, which may exceed their limits.
    * `forces` (g, f, 3) [N]: balanced forces of the fingertips on the object, in the frame of the
      hand's root link.
    * `torques` (g, h) [N m or N]: efforts of the actuated joints that exert these forces.

    The targets solve J^T f = K (target - q). Here q are the joints of the grasp, f the forces,
    and J the Jacobian of the contacts. K is diagonal. Each actuated joint has the `kp` of its own
    drive and of its coupled joints, times their squared ratios. Where no balanced forces press at
    every contact, each force is `force` along the inward normal. The targets are differentiable in
    the joints of the grasps. The forces, found by a search, are not differentiable in the contacts.

    Args:
        hand: the hand of the grasps, on any device; the results are on that of the grasps.
        grasps: the grasps.
        force: normal force [N] of the strongest finger.
        kp: stiffness [N m/rad] of every joint's drive; None means the hand's own.

    Raises `BadArgument` for:

    * joints or fingers of another hand, or of one whose geometry has changed since the plan;
    * a `force` outside [0.01, 100] N, or a stiffness that is not positive;
    * contacts or poses that require gradients.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> pressed = squeeze(load_hand("barrett"), load_shipped_grasp("jug", "barrett"))
    >>> pressed.forces.norm(dim=-1).round(decimals=1)
    tensor([[2., 2., 4.]], dtype=torch.float64)
    """
    check_same_hand(hand, grasps)
    for name, x in named_tensors(grasps, "grasps.").items():
        check_dense(name, x, gradients=name == "grasps.joints")
    hand = settle(hand.to(torch.float64), grasps.joints.device)
    joints = grasps.joints.double()
    points, normals = contacts_in_hand(grasps)
    forces = desired_forces(points, normals, force)
    return press(joints, hand.jacobian(joints, points), forces, joint_stiffness(hand, kp))


def check_all_executable(grasps: Grasps) -> None:
    """Raise `BadArgument` if one of the grasps failed a check of the planner (`Grasps.status`).

    A robot would play a failed grasp, too, where a format or a controller knows no status. Imported
    grasps (`grasps_from_joints`) may lack force closure, since their true contacts are unknown.
    """
    planned = "seed" in grasps.meta
    taken = {Status.OK} if planned else {Status.OK, Status.NOT_CLOSED}
    failed = {s: k for s, k in count_status(grasps.status).items() if s not in taken}
    if failed:
        causes = ", ".join(f"{k} {s.name}" for s, k in failed.items())
        found = f"{sum(failed.values())} of {len(grasps)} that failed ({causes})"
        allowed = "executable grasps, as grasps.executable or grasps.best"
        raise BadArgument("grasps", found, allowed)


def check_same_hand(hand: Hand, grasps: Grasps) -> None:
    """Raise `BadArgument` if `grasps` were planned for another hand than `hand`.

    The names of hand, fingers and joints in `grasps.meta` must be those of `hand`. Where
    `grasps.meta` lacks the names, only the numbers of fingers and joints are compared. The
    fingertips must also reach the contacts as well as planned: the hand's geometry may have
    changed. Normals that are no unit vectors or point inwards are refused, too.
    """
    planned = grasps.meta.get("hand", hand.name)
    if planned != hand.name:
        raise BadArgument("hand", hand.name, f"{planned}, for which the grasps were planned")
    names = grasps.meta.get("finger_names", ",".join(hand.finger_names)).split(",")
    count = grasps.contacts.fingertips
    if tuple(names) != hand.finger_names or count != len(names):
        found = f"{count} contacts in each grasp, of the fingers {', '.join(names)}"
        ours = ", ".join(hand.finger_names)
        advice = "`hand_of(grasps)` loads the fingers of grasps"
        raise BadArgument("grasps", found, f"those of the hand: {ours}; {advice}")
    joints = grasps.joints.shape[-1]
    if joints != hand.dof:
        raise BadArgument("grasps", f"{joints} joints", f"the {hand.dof} joints of {hand.name}")
    named = grasps.meta.get("joint_names", ",".join(hand.joint_names))
    if named != ",".join(hand.joint_names):
        ours = ", ".join(hand.joint_names)
        raise BadArgument("grasps", f"the joints {named}", f"those of the hand: {ours}")
    if is_known(grasps.joints):
        _check_reached(hand, grasps)


@torch.no_grad()
def _check_reached(hand: Hand, grasps: Grasps) -> None:
    """Raise `BadArgument` if fingertips are farther from their contacts than they were planned.

    Then the hand's geometry is another one than that of the plan, or the contacts were changed.
    Raise it for normals that are no unit vectors, too, or that point into the object.
    """
    grasps = grasps.to("cpu", torch.float64)
    points, normals = contacts_in_hand(grasps)
    hand = hand.to("cpu", torch.float64)
    pads, _ = hand.fingertips(grasps.joints)
    centres = hand.tip_centres(grasps.joints)
    rolled = points + hand.tips.radius[:, None] * normals
    check_unit_vectors("grasps.contacts.normals", normals)
    behind = dot(centres - points, normals) < 0
    good = grasps.status == Status.OK
    if behind[good].all(-1).any():
        found = "normals that point from fingertips into the object"
        raise BadArgument("grasps.contacts.normals", found, "outward normals of the object")
    # the pad lies at the contact, or the fingertip has rolled on it
    off = torch.minimum(norm(pads - points), norm(centres - rolled))
    most = CHANGED
    if grasps.meta.get("hand_sha256") == hand.source.sha256:
        # the same hand: contacts may be known better than they were planned
        off = torch.minimum(off, (norm(centres - points) - hand.tips.radius).abs())
        most = MOVED
    if (off > grasps.tip_error + most).any():
        largest = 1000 * float(off.nan_to_num().max())
        found = f"{hand.name}, whose fingertips are up to {largest:.0f} mm off the contacts"
        raise BadArgument("hand", found, "the hand and the contacts that were planned")


def press(
    joints: Float[Tensor, "g h"],
    jacobian: Float[Tensor, "g f 3 h"],
    forces: Float[Tensor, "g f 3"],
    stiffness: Float[Tensor, " h"],
) -> Squeeze:
    """Return the joint targets and torques with which position-controlled drives exert the `forces`
    in g grasps.

    `joints` [rad] are the present positions of the h actuated joints. `jacobian` [m/rad] is that of
    the f contact points by these joints. `forces` [N] act on the object, in the frame of the
    Jacobian. `stiffness` [N m/rad] is that of each actuated joint. For sliding joints, metres
    replace radians, and newtons replace newton metres.
    """
    torques = torch.einsum("gcih,gci->gh", jacobian, forces)
    return Squeeze(joints + torques / stiffness, forces, torques)


def tip_compliance(
    jacobian: Float[Tensor, "*b f 3 h"],
    normals: Float[Tensor, "*b f 3"],
    stiffness: Float[Tensor, "h"],
) -> Float[Tensor, "*b f"]:
    """Return the compliance [m/N] of each fingertip along its contact normal.

    `jacobian` [m/rad] is that of the contact points by the h actuated joints, whose `stiffness` [N
    m/rad] is given. `normals` are unit vectors in the frame of the Jacobian. f counts fingertips,
    and `*b` stands for any leading axes.
    """
    along = torch.einsum("...cih,...ci->...ch", jacobian, normals)
    return (along**2 / stiffness).sum(-1)
