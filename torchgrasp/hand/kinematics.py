"""Forward kinematics of a pytorch-kinematics chain, compiled from its tensors.

All postures are computed at once, level by level of the tree. The pose of a child link in its
parent is `constant + sine sin q + cosine cos q + slide q`. Here q [rad or m] is the position of the
joint between them. The four tables are computed once. Poses (3 x 4) are the upper rows of 4 x 4
transforms [m]. n counts postures, l links, j joints, p points.
"""

import dataclasses
import functools
from collections.abc import Collection, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, flatnonzero, row_numbers
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import pytorch_kinematics
from torchgrasp.foundation.rules import is_known
from torchgrasp.geometry.frames import real, skew
from torchgrasp.geometry.linalg import eye_like
from torchgrasp.hand.urdf import Urdf, pose_of

Frames = Float[Tensor, "3 4 l n"]  # poses (3 x 4) of l links in n postures


@dataclasses.dataclass(frozen=True, eq=False)
class KinematicTree(Value):
    """The forward kinematics of a URDF, as tensors for its l links and j movable joints. A `Hand`
    holds it as `tree`.

    Call `poses` to get the poses of all links for given joint positions. `frames` returns them in
    another layout, and `joint_axes` the axes of the joints. These functions use the attributes.

    The root link of a hand is its palm. A tree can be a part of a URDF: `Fingertips.chains` holds
    only the links that lead to the fingertips. The joints are always those of the whole URDF.

    In `tables`, `joint` and `parent`, links are sorted by level. The level of a link is the number
    of joints between root and link, fixed ones too.

    Attributes:
        link_names: names of the l links, in the order of the URDF.
        joint_names: names of the j movable joints, in the order of the URDF.
        child: index (j,) in `link_names` of the link that each joint moves. If this link is not in
            the tree, the index is 0 without a meaning: the joint's column of `moves` is 0.
        axis: unit axis (j, 3) of each joint, in the frame of the link that it moves.
        prismatic: numbers (j,), 1 for a sliding joint and 0 for others.
        moves: numbers (l, j), 1 if the joint moves the link and 0 if not; links are in the order of
            `link_names`.
        tables: pose [m] of each link in its parent as four 3 x 4 tables (4, 3, 4, l, 1). The first
            is the constant part. The others are multiplied by sin q, cos q and q, where q is the
            position of the link's joint.
        joint: index (l,) in `joint_names` of the joint between each link and its parent. For a
            fixed link and the root it is 0 without a meaning: their `tables` have only the constant
            part.
        parent: index (l,) of each link's parent among the links of the level above; 0 for the root,
            which has no parent.
        level_sizes: number of links in each level, the root's first.
        places: index (l,) of each of `link_names` among the sorted links.
        slides: whether any joint is prismatic.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> every = hand.expand_joints(hand.lower[None])
    >>> poses = hand.tree.poses(every)
    >>> torch.equal(poses[0, :, :3].permute(1, 2, 0), hand.tree.frames(every.T)[..., 0])
    True
    """

    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    child: Int[Tensor, " j"]
    axis: Float[Tensor, "j 3"]
    prismatic: Float[Tensor, " j"]
    moves: Float[Tensor, "l j"]
    tables: Float[Tensor, "4 3 4 l 1"]
    joint: Int[Tensor, " l"]
    parent: Int[Tensor, " l"]
    level_sizes: tuple[int, ...]
    places: Int[Tensor, " l"]
    slides: bool

    @checked(gradients=True)
    def frames(
        self, values: Float[Tensor, "j n"], root: Float[Tensor, "3 4 n"] | None = None
    ) -> Frames:
        """Return the poses (3, 4, l, n) [m] of the l links, in the order of `link_names`, in n
        postures.

        The last row of each 4 x 4 matrix is left out; `poses` returns whole matrices.

        Args:
            values: positions (j, n) [rad or m] of all j movable joints of the URDF, in the order of
                `joint_names`.
            root: poses (3, 4, n) [m] of the root link in another frame, in which the result then
                is. None means the root's own frame.
        """
        constant, sine, cosine, slide = self.tables.to(values).unbind()
        local = torch.addcmul(constant, sine, values.sin().index_select(0, self.joint))
        local = torch.addcmul(local, cosine, values.cos().index_select(0, self.joint))
        if self.slides:
            local = torch.addcmul(local, slide, values.index_select(0, self.joint))
        levels = local.split(self.level_sizes, 2)
        parents = self.parent.split(self.level_sizes)
        frames = [levels[0]] if root is None else [root[:, :, None]]
        for k in range(1, len(levels)):
            if root is None and k == 1:  # the root is the identity
                frames.append(levels[k])
                continue
            first, second, third = levels[k].unbind()  # rows (4, l, n)
            x, y, z, origin = frames[-1].index_select(2, parents[k])[:, :, None].unbind(1)
            frame = x * first
            frame = torch.addcmul(frame, y, second)
            frame = torch.addcmul(frame, z, third)
            frame[:, 3:].add_(origin)
            frames.append(frame)
        return torch.cat(frames, 2).index_select(2, self.places)

    @checked(gradients=True)
    def poses(self, values: Float[Tensor, "n j"]) -> Float[Tensor, "n l 4 4"]:
        """Return the poses `root_from_link` (n, l, 4, 4) [m] of the l links in n postures.

        Links are in the order of `link_names`, and joints in that of `joint_names`. `values` (n, j)
        [rad or m] are positions of all j movable joints of the URDF.
        """
        frames = self.frames(values.T.contiguous())
        last = eye_like(4, frames)[3, :, None, None].expand(1, 4, *frames.shape[2:])
        return torch.cat([frames, last]).permute(3, 2, 0, 1)

    @checked(gradients=True)
    def joint_axes(
        self, poses: Float[Tensor, "*b l 4 4"]
    ) -> tuple[Float[Tensor, "*b j 3"], Float[Tensor, "*b j 3"]]:
        """Return (axes, origins) of the j movable joints, both (*b, j, 3).

        An axis is a unit vector. An origin [m] is that of the link which the joint moves; it lies
        on the joint's axis. Both are in the frame of `poses`.

        Args:
            poses: poses (*b, l, 4, 4) [m] of the l links in any one frame, as `poses` returns them.
        """
        frames = poses.reshape(-1, *poses.shape[-3:])[..., :3, :].permute(2, 3, 1, 0)
        child = frames.index_select(2, self.child)  # (3, 4, j, n)
        axes = map_directions(child, self.axis).permute(2, 1, 0)
        origins = child[:, 3].permute(2, 1, 0)
        size = (*poses.shape[:-3], len(self.child), 3)
        return axes.reshape(size), origins.reshape(size)


@dataclasses.dataclass(frozen=True)
class FreeMotion(Value):
    """Constant matrices for derivatives of link poses of a free-floating hand, and of points and
    directions on its links.

    A step is a small change of pose and joints, with d = 6 + h numbers. They are a translation [m]
    and a rotation vector [rad] along the root link's axes, then h actuated joints [rad or m]. A
    step makes the hand perform q motions, each a translation [m] or a rotation [rad]. The first six
    are translations along the root's axes, then rotations about them. The others are the motions of
    all joints that an actuated joint moves.

    A marker is a point or a direction that is fixed to a link. The m markers come in groups, first
    those given to `of`. Three groups of q markers follow, with one marker for each motion: its
    origin, its rotation axis and its translation axis. The axis of the other kind is zero.
    """

    # matrix that gives x, y or z of the m markers from row x, y or z of the poses (3 x 4) of the l
    # links; these rows have k = 4 l numbers, in the order column of the pose, then link
    product: Float[Tensor, "m k"]
    sizes: tuple[int, ...]  # number of markers in each group
    moves: Float[Tensor, "l q"]  # 1 if motion q moves link l, else 0
    # matrix from a step to the motions; None means the identity
    coupling: Float[Tensor, "q d"] | None

    @classmethod
    def of(
        cls,
        tree: KinematicTree,
        coupling: Float[Tensor, "j h"],
        markers: Sequence[tuple[Int[Tensor, "_"], Float[Tensor, "_ 3"], float]],
    ) -> "FreeMotion":
        """Return the matrices for the hand with the kinematic `tree`, and for given groups of
        markers.

        `markers` has (links, coordinates, number) for each group. They are the indices of the
        markers' links in `tree.link_names`, and the markers' coordinates in the frames of these
        links. The number is 1 for points [m], and 0 for directions. `coupling` (j, h) is the motion
        of each movable joint for a unit motion of each actuated joint.
        """
        own = flatnonzero((coupling != 0).any(1))
        eye = functools.partial(torch.eye, dtype=tree.axis.dtype, device=tree.axis.device)
        axes = eye(3)
        slides = tree.prismatic[own]
        root = flatnonzero(tree.places == 0).expand(6)
        link = torch.cat([root, tree.child[own]])
        slides = slides[:, None]
        turning = torch.cat([0 * axes, axes, tree.axis[own] * (1 - slides)])
        sliding = torch.cat([axes, 0 * axes, tree.axis[own] * slides])
        groups = [
            *markers,
            (link, torch.zeros_like(turning), 1.0),
            (link, turning, 0.0),
            (link, sliding, 0.0),
        ]
        at = torch.cat([links for links, _, _ in groups])
        # homogeneous coordinates: the last is 1 for points, 0 for directions
        local = []
        for _, x, kind in groups:
            last = torch.full_like(x[:, :1], kind)
            local.append(torch.cat([x, last], 1).to(axes))
        product = axes.new_zeros(len(at), 4, len(tree.link_names))
        product[row_numbers(at), :, at] = torch.cat(local)
        moves = torch.cat([axes.new_ones(len(tree.moves), 6), tree.moves[:, own]], 1)
        whole = torch.block_diag(eye(6), coupling[own])
        if torch.equal(whole, eye(len(whole))):
            whole = None
        return cls(product.flatten(1), tuple(map(len, local)), moves, whole)

    def place(self, frames: Frames) -> tuple[Float[Tensor, "3 p n"], ...]:
        """Return the coordinates (3, p, n) of each group of p markers in n postures.

        `frames` (3, 4, l, n) are the poses [m] of all l links, from `KinematicTree.frames`. The
        result is in the same frame as they are, such as that of the root link. Points are in [m];
        directions keep their lengths.
        """
        product = self.product.to(frames).expand(3, -1, -1)
        return torch.bmm(product, frames.flatten(1, 2)).split(self.sizes, 1)


def map_points(
    frames: Float[Tensor, "3 4 p n"], local: Float[Tensor, "p 3"]
) -> Float[Tensor, "3 p n"]:
    """Return the coordinates (3, p, n) [m] of p points on links, in the root's frame and n
    postures.

    `frames` (3, 4, p, n) holds the pose (3 x 4) [m] of each point's link in the root's frame.
    `local` (p, 3) [m] holds the points in the frames of their links.
    """
    return map_directions(frames, local) + frames[:, 3]


def map_directions(
    frames: Float[Tensor, "3 4 p n"], local: Float[Tensor, "p 3"]
) -> Float[Tensor, "3 p n"]:
    """Return the components (3, p, n) of p directions on links, in the root's frame and n postures.
    Their lengths and unit are those of `local`.

    `frames` (3, 4, p, n) holds the pose (3 x 4) [m] of each direction's link in the root's frame.
    `local` (p, 3) holds the directions in the frames of their links.
    """
    x, y, z = local.to(frames)[:, :, None].unbind(1)
    mapped = torch.addcmul(frames[:, 0] * x, frames[:, 1], y)
    return torch.addcmul(mapped, frames[:, 2], z)


def chain_from_urdf(urdf: Urdf) -> "pytorch_kinematics.chain.Chain":
    """Return a URDF as a pytorch-kinematics chain of independent joints, in float64.

    The reader of pytorch-kinematics gives float32.
    """
    frame = pytorch_kinematics.frame
    with torch.device("cpu"):  # the library makes some tensors on torch's default device
        still = frame.Joint(dtype=torch.float64)
        frames = {urdf.root: frame.Frame(urdf.root, frame.Link(urdf.root), still)}
        for j in urdf.joints:
            place = torch.from_numpy(pose_of(j))
            ranges = (j.lower, j.upper), (-j.velocity, j.velocity), (-j.effort, j.effort)
            kind = "revolute" if j.kind == "continuous" else j.kind
            offset = pytorch_kinematics.transforms.Transform3d(matrix=place)
            joint = frame.Joint(j.name, offset, kind, j.axis, torch.float64, "cpu", *ranges)
            frames[j.child] = frame.Frame(j.child, frame.Link(j.child), joint)
        for j in urdf.joints:
            frames[j.parent].add_child(frames[j.child])
        return pytorch_kinematics.chain.Chain(frames[urdf.root], torch.float64)


def tree_from_urdf(
    urdf: Urdf, chain: Any = None, ends: Collection[str] | None = None
) -> KinematicTree:
    """Return the kinematic tree of a URDF, with links in the order of the URDF.

    `chain` is the URDF as a pytorch-kinematics chain; None means that it is made here. `ends` holds
    names of links: the result is then the part of the tree that leads from the root to these links.
    None means the whole tree.
    """
    model: Any = chain or chain_from_urdf(urdf)  # it declares no types
    index = model.frame_to_idx
    paths = [path.tolist() for path in model.parents_indices]
    named = index if ends is None else (urdf.root, *ends)
    part = {k for name in named for k in paths[index[name]]}
    at = [k for x in urdf.links if (k := index[x.name]) in part]
    deepest = max(len(paths[k]) for k in at)
    levels = [[k for k in at if len(paths[k]) == depth] for depth in range(1, 1 + deepest)]
    order = [k for level in levels for k in level]
    names = [j.name for j in urdf.movable]
    moved = model.get_joint_parameter_names()
    own = model.joint_indices.tolist()
    slides = model.joint_type_indices == 2
    joints = [moved.index(name) for name in names]
    frames = [own.index(k) for k in joints]
    parents = [
        levels[depth - 1].index(paths[k][-2]) if depth else 0
        for depth, level in enumerate(levels)
        for k in level
    ]
    new: Any = functools.partial(torch.tensor, device="cpu")
    return KinematicTree(
        link_names=tuple(model.idx_to_frame[k] for k in at),
        joint_names=tuple(names),
        child=new([at.index(k) if k in part else 0 for k in frames], dtype=torch.long),
        axis=model.axes[joints],
        prismatic=slides[frames].to(model.axes),
        moves=real([[float(k in paths[link]) for k in frames] for link in at]),
        tables=torch.stack([_tables(model, k) for k in order], -1)[..., None],
        joint=new([joints.index(own[k]) if own[k] >= 0 else 0 for k in order]),
        parent=new(parents),
        level_sizes=tuple(map(len, levels)),
        places=new([order.index(k) for k in at]),
        slides=bool(slides[at].any()),
    )


def chain_poses(
    chain: "pytorch_kinematics.chain.Chain", names: Sequence[str], values: Float[Tensor, "j n"]
) -> Float[Tensor, "c n 4 4"]:
    """Return the poses (c, n, 4, 4) [m] of a chain's c links in the root's frame, computed by
    pytorch-kinematics. The links are in the order of the chain.

    `values` (j, n) [rad or m] holds n postures of all j movable joints, in the order of `names`.
    Raises `BadArgument` inside torch.vmap.
    """
    if not (torch.compiler.is_compiling() or is_known(values)):
        raise BadArgument(
            "backend",
            "pytorch_kinematics inside torch.vmap",
            "torchgrasp: the other writes in place",
        )
    columns = [names.index(name) for name in chain.get_joint_parameter_names()]
    # the library's analytical gradient has no second derivatives
    return chain.forward_kinematics_tensor(values[columns].T.to(chain.dtype), analytical_grad=False)


def pose_in_carrier(
    chain: "pytorch_kinematics.chain.Chain", link: str
) -> tuple[str, Float[Tensor, "3 4"]]:
    """Return the name of a link's carrier, then the pose (3, 4) [m] of the link in the carrier's
    frame.

    The last row of the 4 x 4 matrix is left out. The carrier is the nearest link, the link itself
    or one above, that a joint moves directly. If no joint moves any of them, it is the root link.
    """
    *above, carrier = chain.parents_indices[chain.frame_to_idx[link]].tolist()
    pose = _tables(chain, 0)[0]
    while above and chain.joint_indices[carrier] < 0:
        rotation, position = _tables(chain, carrier)[0].split([3, 1], 1)
        turned = rotation @ pose[:, :3]
        moved = rotation @ pose[:, 3:] + position
        pose = torch.cat([turned, moved], 1)
        carrier = above.pop()
    return chain.idx_to_frame[carrier], pose


def _tables(chain: "pytorch_kinematics.chain.Chain", frame: int) -> Float[Tensor, "4 3 4"]:
    """Return four 3 x 4 tables. A frame's pose in its parent is their sum, weighted by 1, sin q,
    cos q and q.
    """
    offset = chain.joint_offsets[frame]
    kind = chain.joint_type_indices[frame]
    joint = chain.joint_indices[frame]
    tables = chain.identity.new_zeros(4, 3, 4)
    constant, sine, cosine, slide = tables
    constant[:] = (chain.identity if offset is None else offset)[0, :3]
    rotation = constant[:, :3].clone()
    axis = chain.axes[joint]
    if kind == 2:
        slide[:, 3] = rotation @ axis
    elif kind == 1:  # Rodrigues: I + K sin q + K^2 (1 - cos q), K the cross product with the axis
        cross = skew(axis)
        sine[:, :3] = rotation @ cross
        cosine[:, :3] = -rotation @ cross @ cross
        constant -= cosine
    return tables
