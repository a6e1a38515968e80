"""Forward kinematics of a URDF's tree, level by level, for all postures at once.

The pose of a child link in its parent is `constant + sine sin q + cosine cos q + slide q`, where q is the position of
the joint between them. The four tables are computed once.
"""

import dataclasses
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import checked
from torchgrasp.geometry.frames import rotation_from_rpy, skew
from torchgrasp.hand.urdf import Joint, Urdf

if TYPE_CHECKING:
    from pytorch_kinematics import Chain


@dataclasses.dataclass(frozen=True, eq=False)
class KinematicTree(Value):
    """The kinematic tree of a URDF, or a part of it, as tables; links and joints are in the order of the file.

    `child[j]` is the link that joint j moves, or 0 if it is outside this part; `axis` is in that link's frame.
    `prismatic` is 1 for a sliding joint, and `moves[l, j]` is 1 if joint j moves link l.

    `tables` hold each link's pose in its parent: its constant part, and factors of sin q, cos q and q. In them, links
    are sorted by level, the number of joints from the root; `level_sizes` counts the links of each level. `joint` is
    the index of the joint that moves a link, 0 for a fixed link. `parent` is the index of a link's parent in the level
    above. `places` are the indices of `link_names` among the sorted links.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> every = hand.expand_joints(hand.lower[None])
    >>> poses = hand.tree.poses(every)
    >>> torch.equal(poses[0, :, :3].permute(1, 2, 0), hand.tree.frames(every.T)[..., 0])
    True
    >>> axes, origins = hand.tree.joint_axes(poses)
    >>> axes.shape
    torch.Size([1, 8, 3])
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
    ) -> Float[Tensor, "3 4 l n"]:
        """Return every link's pose (3 x 4) in the root's frame, given the joint positions (j, n) of n postures.

        If `root` gives the poses of the root in another frame, the link poses are in that frame.
        """
        constant, sine, cosine, slide = self.tables.to(values).unbind()
        local = torch.addcmul(constant, sine, values.sin().index_select(0, self.joint))
        local = torch.addcmul(local, cosine, values.cos().index_select(0, self.joint))
        if self.slides:
            local = torch.addcmul(local, slide, values.index_select(0, self.joint))
        levels, parents = local.split(self.level_sizes, 2), self.parent.split(self.level_sizes)
        frames = [levels[0]] if root is None else [root[:, :, None]]
        for k in range(1, len(levels)):
            level = levels[k]
            if root is None and k == 1:  # the root is the identity
                frames.append(level)
                continue
            above = frames[-1].index_select(2, parents[k])
            frame = above[:, 0, None] * level[0]
            frame = torch.addcmul(frame, above[:, 1, None], level[1])
            frame = torch.addcmul(frame, above[:, 2, None], level[2])
            frame[:, 3] += above[:, 3]
            frames.append(frame)
        return torch.cat(frames, 2).index_select(2, self.places)

    @checked(gradients=True)
    def poses(self, values: Float[Tensor, "n j"]) -> Float[Tensor, "n l 4 4"]:
        """Return the pose `root_from_link` of every link, given all movable joints [rad or m]."""
        frames = self.frames(values.T.contiguous())
        last = torch.eye(4, dtype=frames.dtype, device=frames.device)[3, :, None, None].expand(1, 4, *frames.shape[2:])
        return torch.cat([frames, last]).permute(3, 2, 0, 1)

    @checked(gradients=True)
    def joint_axes(self, poses: Float[Tensor, "*b l 4 4"]) -> tuple[Float[Tensor, "*b j 3"], Float[Tensor, "*b j 3"]]:
        """Return the unit axis and a point [m] of every joint in the root's frame, given the link poses."""
        child = poses.reshape(-1, *poses.shape[-3:])[..., :3, :].permute(2, 3, 1, 0).index_select(2, self.child)
        axes, origins = (x.permute(2, 1, 0) for x in (map_directions(child, self.axis), child[:, 3]))
        size = (*poses.shape[:-3], len(self.child), 3)
        return axes.reshape(size), origins.reshape(size)


@dataclasses.dataclass(frozen=True)
class FreeMotion(Value):
    """Tables of how the links of a free-floating hand, and marker points fixed to the links, move in a small step.

    The q motions are three translations along the root's axes, three rotations about them, and the joints that the
    actuated joints move. `moves[l, q]` is 1 if motion q moves link l. `coupling` maps a step of pose (six numbers) and
    actuated joints to the motions; None means the identity.

    `product` maps all link frames to all markers in one matrix product. The markers come in groups of `sizes`: first
    the given groups, then the origins of all motions, all rotation axes, and all translation axes. One of the two axes
    of a motion is zero.
    """

    product: Float[Tensor, "m k"]
    sizes: tuple[int, ...]
    moves: Float[Tensor, "l q"]
    coupling: Float[Tensor, "q d"] | None

    @classmethod
    def of(
        cls,
        tree: KinematicTree,
        coupling: Float[Tensor, "j h"],
        markers: Sequence[tuple[Int[Tensor, "_"], Float[Tensor, "_ 3"], float]],
    ) -> "FreeMotion":
        """Return the tables for groups of markers: link indices, coordinates, and 1 for points or 0 for directions."""
        own = torch.nonzero((coupling != 0).any(1))[:, 0]
        axes, slides = torch.eye(3).to(tree.axis), tree.prismatic[own]
        root = torch.nonzero(tree.places == 0)[:, 0].expand(6)
        link = torch.cat([root, tree.child[own]])
        turning = torch.cat([0 * axes, axes, tree.axis[own] * (1 - slides[:, None])])
        sliding = torch.cat([axes, 0 * axes, tree.axis[own] * slides[:, None]])
        groups = [*markers, (link, torch.zeros_like(turning), 1.0), (link, turning, 0.0), (link, sliding, 0.0)]
        at = torch.cat([links for links, _, _ in groups])
        local = [torch.cat([x, torch.full_like(x[:, :1], kind)], 1).to(axes) for _, x, kind in groups]
        product = axes.new_zeros(len(at), 4, len(tree.link_names))
        product[torch.arange(len(at), device=at.device), :, at] = torch.cat(local)
        moves = torch.cat([axes.new_ones(len(tree.moves), 6), tree.moves[:, own]], 1)
        whole = torch.block_diag(torch.eye(6).to(axes), coupling[own])
        same = whole.shape[0] == whole.shape[1] and torch.equal(whole, torch.eye(len(whole)).to(whole))
        return cls(product.flatten(1), tuple(len(x) for x in local), moves, None if same else whole)

    def place(self, frames: Float[Tensor, "3 4 l n"]) -> tuple[Float[Tensor, "3 p n"], ...]:
        """Return the coordinates of each group of markers in the root's frame, given all link frames."""
        product = self.product.to(frames).expand(3, -1, -1)
        return torch.bmm(product, frames.flatten(1, 2)).split(self.sizes, 1)


def map_points(frames: Float[Tensor, "3 4 p n"], local: Float[Tensor, "p 3"]) -> Float[Tensor, "3 p n"]:
    """Return points in the root's frame, given the link frames (3 x 4) and one point in each of them."""
    return map_directions(frames, local) + frames[:, 3]


def map_directions(frames: Float[Tensor, "3 4 p n"], local: Float[Tensor, "p 3"]) -> Float[Tensor, "3 p n"]:
    """Return directions in the root's frame, given the link frames (3 x 4) and one direction in each of them."""
    x, y, z = local.to(frames)[:, :, None].unbind(1)
    return torch.addcmul(torch.addcmul(frames[:, 0] * x, frames[:, 1], y), frames[:, 2], z)


def tree_from_urdf(urdf: Urdf, ends: Collection[str] | None = None) -> KinematicTree:
    """Return the kinematic tree of a URDF, or the part of it that leads to the links `ends`."""
    above = {j.child: j for j in urdf.joints}
    part = {x.name for x in urdf.links} if ends is None else {urdf.root, *ends}
    part |= {j.parent for end in ends or () for j in urdf.joints_above(end)}
    levels = [[urdf.root]]
    while below := [x.name for x in urdf.links if x.name in part & set(above) and above[x.name].parent in levels[-1]]:
        levels.append(below)
    names = [name for level in levels for name in level]
    links = [x.name for x in urdf.links if x.name in part]
    joints, index = urdf.movable, {j.child: k for k, j in enumerate(urdf.movable)}
    parents = [[levels[k - 1].index(above[n].parent) if k else 0 for n in level] for k, level in enumerate(levels)]
    movers = {name: set(urdf.joints_above(name)) for name in links}
    return KinematicTree(
        link_names=tuple(links),
        joint_names=tuple(j.name for j in joints),
        child=torch.tensor([links.index(j.child) if j.child in part else 0 for j in joints], dtype=torch.long),
        axis=torch.tensor([j.axis for j in joints], dtype=torch.float64).reshape(-1, 3),
        prismatic=torch.tensor([float(j.kind == "prismatic") for j in joints], dtype=torch.float64),
        moves=torch.tensor([[float(j in movers[n]) for j in joints] for n in links], dtype=torch.float64),
        tables=torch.stack([_tables(above.get(name)) for name in names], -1)[..., None],
        joint=torch.tensor([index.get(name, 0) for name in names]),
        parent=torch.tensor([k for level in parents for k in level]),
        level_sizes=tuple(len(level) for level in levels),
        places=torch.tensor([names.index(name) for name in links]),
        slides=any(j.kind == "prismatic" and j.child in part for j in joints),
    )


def chain_from_urdf(urdf: Urdf, dtype: torch.dtype = torch.float64) -> "Chain":
    """Return a URDF as a pytorch-kinematics chain with unrounded angles; coupled joints become independent."""
    from pytorch_kinematics.chain import Chain
    from pytorch_kinematics.frame import Frame, Link
    from pytorch_kinematics.frame import Joint as Mover
    from pytorch_kinematics.transforms import Transform3d

    frames = {urdf.root: Frame(urdf.root, Link(urdf.root), Mover(dtype=dtype))}
    for j in urdf.joints:
        offset = Transform3d(
            dtype=dtype, rot=rotation_from_rpy(j.rpy).to(dtype), pos=torch.tensor([j.xyz], dtype=dtype)
        )
        limits, speeds, efforts = (j.lower, j.upper), (-j.velocity, j.velocity), (-j.effort, j.effort)
        mover = Mover(j.name, offset, j.kind, j.axis, dtype, "cpu", limits, speeds, efforts)
        frames[j.child] = Frame(j.child, Link(j.child), mover)
    for j in urdf.joints:
        frames[j.parent].add_child(frames[j.child])
    return Chain(frames[urdf.root], dtype)


def pose_in_carrier(urdf: Urdf, link: str) -> tuple[str, Float[Tensor, "3 4"]]:
    """Return a link's carrier (the nearest link, itself or above, that a joint moves), and the link's pose in it."""
    above = {j.child: j for j in urdf.joints}
    pose = _tables(None)[0]
    while link in above and above[link].kind == "fixed":
        step = _tables(above[link])[0]
        pose = torch.cat([step[:, :3] @ pose[:, :3], step[:, :3] @ pose[:, 3:] + step[:, 3:]], 1)
        link = above[link].parent
    return link, pose


def _tables(joint: Joint | None) -> Float[Tensor, "4 3 4"]:
    """Return four 3 x 4 tables: a joint's pose in its parent is their sum, weighted by 1, sin q, cos q and q."""
    tables = torch.zeros(4, 3, 4, dtype=torch.float64)
    constant, sine, cosine, slide = tables
    if joint is None:
        constant[:, :3] = torch.eye(3)
        return tables
    rotation = rotation_from_rpy(joint.rpy)
    constant[:, :3], constant[:, 3] = rotation, torch.tensor(joint.xyz, dtype=torch.float64)
    axis = torch.tensor(joint.axis, dtype=torch.float64)
    if joint.kind == "prismatic":
        slide[:, 3] = rotation @ axis
    elif joint.kind == "revolute":  # Rodrigues: I + K sin q + K^2 (1 - cos q), K the cross product with the axis
        cross = skew(axis)
        sine[:, :3], cosine[:, :3] = rotation @ cross, -rotation @ cross @ cross
        constant[:, :3] -= cosine[:, :3]
    return tables
