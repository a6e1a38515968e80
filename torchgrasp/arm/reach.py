"""Inverse kinematics of an arm: which hand poses it reaches, and its way through a grasp.

Postures are moved by damped least squares until the hand is in place. The first are those of the
arm's library whose tips are nearest. Along a way, each posture starts from the one before. A way is
w poses of the hand: the straight approach of the opened hand, the grasp, the lift. Here g counts
grasps, k postures or poses, and n the joints of the arm. Positions of joints are in [rad], or in
[m] for sliding joints.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.arm.arm import LEVER, Arm, TipPoses, features
from torchgrasp.foundation.base import flatnonzero, in_chunks
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.optim import SOLVED
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, level
from torchgrasp.ik.motion import APPROACH_DISTANCE, COARSE_STEPS, UP, opened_pose
from torchgrasp.values.planning import Grasps


@dataclasses.dataclass(frozen=True)
class ReachNumbers:
    """Numbers of an arm's inverse kinematics and of its way through a grasp.

    Steps are those of the inverse kinematics' solver. A way leads the hand through a straight
    approach, the grasp and the lift.
    """

    tried: int = 4
    """Number of postures of the library from which a pose is tried."""
    tried_steps: int = 8
    """Greatest number of steps from each of the `tried` postures."""
    starts: int = 8
    """Number of postures of the library from which a grasp is tried."""
    steps: int = 12
    """Greatest number of steps from each of the `starts` postures."""
    solved: float = 1e-4
    """Sum of squared errors [mm2] at which an arm's tip has reached its place: (0.01 mm)^2."""
    way_steps: int = 4
    """Greatest number of steps from one pose of the way to the next."""
    lift: float = 0.1
    """Height [m] of the lift."""
    speed: float = 0.1
    """Speed [m/s] of the tip on the way; a way on which a joint would be too fast is refused."""
    between: int = 8
    """Number of poses along a way from one test of links for collisions with each other to the
    next.
    """
    postures: int = 256
    """Number of postures that are compared at a time, which bounds the memory."""
    ways: int = 64
    """Number of ways that are checked for collisions at a time."""
    rounding: float = 1e-12
    """Least sine by which a rotation's angle is divided, so that no division is by 0."""


REACH = ReachNumbers()
Way = tuple[Float[Tensor, "g w n"], Bool[Tensor, "g"], Float[Tensor, "g 2"]]
"""The w postures [rad or m] on the way through each grasp. Also a mask of the grasps with a way,
and the ease of the way, as in `Grasps`.
"""


def reach_poses(arm: Arm, obj_from_hand: Float[Tensor, "k 4 4"]) -> Bool[Tensor, "k"]:
    """Return a mask (k,) of the k hand poses `obj_from_hand` [m] that the arm reaches within its
    joint limits.

    Up to 4 postures of the arm's library are tried for each pose (`REACH.tried`). The poses are
    those of the hand's root link in the object's frame. Collisions are not tested.
    """
    target = arm.tip_poses(obj_from_hand)  # (3, 4, k)
    reached = target.new_zeros(len(obj_from_hand), dtype=torch.bool)
    for start in _nearest(arm, target, REACH.tried).unbind(1):
        left = flatnonzero(~reached)
        joints = arm.library[start[left]].T  # (n, k)
        _, found = solve_tips(arm, joints, target[..., left], REACH.tried_steps, SOLVED)
        reached[left] = found
    return reached.to(obj_from_hand.device)


def with_arm(
    arm: Arm, hand: Hand, grasps: Grasps, world: CollisionWorld, up: Float[Tensor, "3"]
) -> Grasps:
    """Return grasps with the arm's posture at each, and the status `UNREACHABLE` where the arm
    cannot follow.

    The arm must follow the hand on its way: the straight approach, the grasp and the lift. The
    field `arm` holds the joints [rad or m] of the arm at the grasp. The field `ease` holds two
    least numbers on the way (`measure_ease`). First is the distance of a joint from its nearer
    limit, as a share of half its range. Second is the manipulability [m^3]. Both fields are 0 where
    the arm cannot follow, and for grasps that were not executable. `world` holds what the arm must
    not touch. Without a table there, the grasp is lifted along the unit vector `up`.
    """
    rows = flatnonzero(grasps.status == Status.OK)
    way, found, least = follow_grasps(arm, hand, grasps[rows], world, up)
    status = grasps.status.index_fill(0, rows[~found], int(Status.UNREACHABLE))
    joints = way.new_zeros(len(grasps), way.shape[2])
    joints = joints.index_copy(0, rows, way[:, COARSE_STEPS + 1])
    ease = least.new_zeros(len(grasps), 2).index_copy(0, rows, least)
    return dataclasses.replace(grasps, status=status, arm=joints, ease=ease)


def follow_grasps(
    arm: Arm, hand: Hand, grasps: Grasps, world: CollisionWorld, up: Float[Tensor, "3"] = UP
) -> Way:
    """Return the arm's postures on its way through each of g grasps: the straight approach, the
    grasp, the lift.

    The first result holds the w postures (g, w, n) [rad or m] of the arm's n joints. It is zero
    where there is no way. The second is a mask (g,) of the grasps that have a way. The third (g, 2)
    holds two least numbers on the way (`measure_ease`). First is the distance of a joint from its
    nearer limit, as a share of half its range. Second is the manipulability [m^3].

    On a way the arm stays within its joint limits and does not jump. Its links collide neither with
    the `world`, nor with each other or the palm. Several postures may reach the grasp. The way goes
    through the easiest one from which the arm can follow all of it. Easiest is that with the
    greatest product of these two numbers at the grasp. If the `world` has no table, the hand is
    lifted along the unit vector `up`.
    """
    poses = way_of(hand, grasps, world, up).to(arm.lower)
    starts = REACH.starts
    at = COARSE_STEPS + 1
    g, w = poses.shape[:2]
    tips = arm.tip_poses(poses.flatten(0, 1)).unflatten(2, (g, w))  # (3, 4, g, w)
    target = tips[..., at]
    near = _nearest(arm, target, starts).flatten()
    joints, solved = solve_tips(arm, arm.library[near].T, target.repeat_interleave(starts, 2))

    def clear(path: Float[Tensor, "g w n"]) -> tuple[Bool[Tensor, "g"]]:
        return (_is_clear(arm, path, world),)

    solved &= in_chunks(clear, joints.T[:, None], REACH.postures)[0]
    ease = torch.where(solved, measure_ease(arm, joints).prod(1), -1.0)
    ease = ease.view(g, starts)
    way = poses.new_zeros(g, w, len(joints))
    found = solved.new_zeros(g)
    least = poses.new_zeros(g, 2)
    # The easiest posture first; a grasp that has its way is done.
    for choice in ease.argsort(dim=1, descending=True, stable=True).unbind(1):
        able = ease.gather(1, choice[:, None])[:, 0] >= 0
        rows = flatnonzero(~found & able)
        if not len(rows):
            break
        start = joints[:, rows * starts + choice[rows]]  # (n, k)
        path, good = track(arm, start, tips[:, :, rows])
        good &= in_chunks(clear, path, REACH.ways)[0]
        rows = rows[good]
        path = path[good]
        way[rows] = path
        found[rows] = True
        along_way = measure_ease(arm, path.flatten(0, 1).T)
        least[rows] = along_way.view(-1, w, 2).amin(1)
    return way, found, least


def way_of(
    hand: Hand, grasps: Grasps, world: CollisionWorld, up: Float[Tensor, "3"] = UP
) -> Float[Tensor, "g w 4 4"]:
    """Return w poses obj_from_hand [m] on the hand's way through each of g grasps: the straight
    approach, then the lift.

    The poses are those of the hand's root link in the object's frame. The opened hand approaches in
    the first half of the poses; the closed hand is lifted in the second half. The lift is along the
    normal of the world's table, or along the unit vector `up` without a table.
    """
    closed = grasps.obj_from_hand
    opened = opened_pose(hand, grasps.pregrasp, closed, world.plane)
    share = torch.linspace(0, 1, COARSE_STEPS + 1, dtype=torch.float32, device="cpu")
    share = share.to(closed)[:, None]
    up = (up if world.plane is None else world.plane.normal).to(closed)
    before, after = (x[:, None].repeat(1, len(share), 1, 1) for x in (opened, closed))
    before[..., :3, 3] -= APPROACH_DISTANCE * (1 - share) * grasps.approach[:, None]
    after[..., :3, 3] += REACH.lift * share * up
    return torch.cat([before, after], 1)


def track(
    arm: Arm, start: Float[Tensor, "n g"], tips: Float[Tensor, "3 4 g w"]
) -> tuple[Float[Tensor, "g w n"], Bool[Tensor, "g"]]:
    """Return arm postures [rad or m] along g ways of w poses, then a mask of the ways without
    jumps.

    A way leads through a grasp. From the grasp, its poses are followed back to its start and on to
    its end. `start` are the postures [rad or m] at the grasps, one in each column. `tips` are the
    poses (3 x 4) [m] of the arm's tip on each way. They are in the frame of the arm's root link. On
    a way without a jump, every pose is reached. The tip moves at 0.1 m/s (`REACH.speed`) there, and
    no joint exceeds its greatest speed.
    """
    at = COARSE_STEPS + 1
    path = {at: start}
    steady = torch.ones_like(start[0], dtype=torch.bool)
    back = [(k, k + 1) for k in reversed(range(at))]
    on = [(k, k - 1) for k in range(at + 1, 2 * at)]
    for k, last in back + on:
        path[k], solved = solve_tips(arm, path[last], tips[..., k], steps=REACH.way_steps)
        moved = torch.linalg.vector_norm(tips[:, 3, :, k] - tips[:, 3, :, last], dim=0)
        seconds = moved / REACH.speed
        turned = (path[k] - path[last]).abs()
        steady &= solved & (turned <= arm.speed[:, None] * seconds).all(0)
    return torch.stack([path[k].T for k in range(2 * at)], 1), steady


def _is_clear(arm: Arm, path: Float[Tensor, "g w n"], world: CollisionWorld) -> Bool[Tensor, "g"]:
    """Return a mask of the ways on which no link touches the world. On whole ways no link touches
    another link or the palm, either.
    """
    centres = arm.sphere_centres(path.flatten(0, 1).T).unflatten(2, path.shape[:2])
    links = centres[:, arm.moving].permute(2, 3, 1, 0)
    radius = arm.radius[arm.moving]
    clear = torch.ones_like(path[:, 0, 0], dtype=torch.bool)
    if world.plane is not None:
        # what only slides, as a base on a rail, may stand on the table
        turning = arm.tree.moves @ (1 - arm.tree.prismatic)  # (l,)
        turns = turning[arm.link[arm.moving]] > 0
        height = level(links[:, :, turns], world.plane) - radius[turns]
        clear &= height.flatten(1).amin(1) >= world.plane.offset
    if world.field is not None:  # a lifted object is not in the way
        gap = world.field.query(links[:, : COARSE_STEPS + 2])[0] - radius
        clear &= gap.flatten(1).amin(1) >= 0
    if world.obstacles is not None and world.guarded:
        gap = world.obstacles.field.query(links)[0] - radius
        clear &= gap.flatten(1).amin(1) >= 0
    if path.shape[1] > 1:
        some = centres[..., :: REACH.between].flatten(2)
        clear &= ~arm.overlaps(some).any(0).view(len(path), -1).any(1)
    return clear


def measure_ease(arm: Arm, joints: Float[Tensor, "n k"]) -> Float[Tensor, "k 2"]:
    """Return two columns for each of k postures: the least room of a joint, then the
    manipulability.

    The room is a joint's distance from its nearer limit, as a share of half its range. The
    manipulability is sqrt(det(J J^T)) [m^3] of the Jacobian J of the tip. `joints` [rad or m] holds
    a posture in each column.
    """
    lower = arm.lower[:, None]
    upper = arm.upper[:, None]
    motion = arm.tip_motion(joints)[1]
    room = 2 * torch.minimum(joints - lower, upper - joints) / (upper - lower)
    jacobian = torch.cat([motion[:3] * MILLIMETRE, motion[3:] / LEVER])
    jacobian = jacobian.permute(2, 0, 1)  # (k, 6, n)
    squared = torch.linalg.det(jacobian @ jacobian.mT)
    return torch.stack([room.amin(0), squared.clamp_min(0).sqrt()], 1)


def _nearest(arm: Arm, target: TipPoses, count: int) -> Int[Tensor, "k s"]:
    """Return the indices of the `count` postures of the library whose tips are nearest to each
    target.
    """
    size = arm.features.square().sum(1) / 2

    def find(wanted: Float[Tensor, "k 12"]) -> tuple[Int[Tensor, "k s"]]:
        # Half the squared distance, but for a summand that all postures share.
        distance = size - wanted @ arm.features.T  # (k, m)
        return (distance.topk(count, 1, largest=False).indices,)

    return in_chunks(find, features(target), REACH.postures)[0]


def solve_tips(
    arm: Arm,
    start: Float[Tensor, "n k"],
    target: TipPoses,
    steps: int = REACH.steps,
    solved: float = REACH.solved,
) -> tuple[Float[Tensor, "n k"], Bool[Tensor, "k"]]:
    """Solve the arm's inverse kinematics: return k postures within the joint limits, and a mask
    (k,) of those whose tip is in place.

    `start` holds a posture [rad or m] in each column. `target` holds the wanted poses (3, 4, k) [m]
    of the tip in the frame of the arm's root link. An error of rotation [rad] counts times 100 mm
    (`LEVER`). A tip is in place if the sum of its squared errors is below `solved` [mm2]. By
    default that is an error of a hundredth of a millimetre. A posture makes at most `steps` steps.
    The damping is half the squared error plus 1 (Sugihara, IEEE Transactions on Robotics 27, 2011).
    """
    joints = start.clone()
    rows = torch.arange(start.shape[1], device=start.device)
    lower = arm.lower[:, None]
    upper = arm.upper[:, None]
    done = torch.zeros_like(rows, dtype=torch.bool)
    for step in range(steps + 1):
        tip, motion = arm.tip_motion(joints[:, rows])
        gap = _gap(tip, target[..., rows])
        error = gap.square().sum(0)
        done[rows] = error < solved
        left = flatnonzero(error >= solved)
        if step == steps or not len(left):
            break
        rows = rows[left]
        motion = motion[..., left]
        gap = gap[:, left]
        error = error[left]
        normal = (motion[:, :, None] * motion[:, None]).sum(0)
        normal.diagonal().T.add_(error / 2 + 1)
        slope = (motion * gap[:, None]).sum(0)
        turn, _ = torch.linalg.solve_ex(normal.permute(2, 0, 1), slope.T)
        turned = joints[:, rows] + turn.T
        joints[:, rows] = turned.clamp(lower, upper)
    return joints, done


def _gap(tip: TipPoses, target: TipPoses) -> Float[Tensor, "6 k"]:
    """Return the translation [mm] from tips to targets, then the rotation vector times `LEVER`
    [mm].
    """
    now = tip[:, :3]
    wanted = target[:, :3]
    axis = torch.linalg.cross(now, wanted, dim=0).sum(1) / 2
    sine = torch.linalg.vector_norm(axis, dim=0)
    cosine = ((now * wanted).sum((0, 1)) - 1) / 2
    angle = torch.atan2(sine, cosine)
    turn = axis * (angle / sine.clamp_min(REACH.rounding))
    move = (target[:, 3] - tip[:, 3]) / MILLIMETRE
    return torch.cat([move, LEVER * turn])
