"""Forward kinematics of a URDF tree, all links of one depth at a time.

A joint's child stands in its parent at `constant + sine sin q + cosine cos q + slide q`, entry by entry. These tables
are made once, from the same tree that pytorch-kinematics reads. A posture then takes one product of 3 by 3 entries for
each depth of the tree, with all postures last in memory, where pytorch-kinematics multiplies a small matrix for each
posture and link. That is kept as the reference by which `torchgrasp.testing.check_hand` checks every hand; it ignores
`<mimic>`, builds offsets in float32, which leaves about 1e-8 m, and its analytical backward has no second derivative.
"""

import dataclasses
from collections.abc import Collection
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.frames import rotation_from_rpy, skew
from torchgrasp.hand.urdf import Joint, Urdf


@dataclasses.dataclass(frozen=True, eq=False)
class Kinematics(Value):
    """The tree of a URDF, or that part of it which leads to some links: names in the order of the file, and tables.

    The tables `constant`, `sine`, `cosine` and `slide` hold each link's frame in its parent's by the value of `joint`,
    an index into `used`, the movable joints of the tree (0 for fixed links, whose tables but the first are zero).
    Links stand in the tables by depth: `depths` counts those of each depth, `parent` is the place of a link's parent
    within the depth before, `straight` tells of which depths the parents are all of that, in order, and `places` are
    depth and place of each of `link_names`. `child` is the link that each of `joint_names` moves, 0 if none of the
    tree, and `axis` the joint's axis in the frame of each link; `slides` tells whether any joint is prismatic.
    """

    xml: bytes
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    depths: tuple[int, ...]
    straight: tuple[bool, ...]
    places: tuple[tuple[int, int], ...]
    slides: bool
    constant: Float[Tensor, "3 4 l 1"]
    sine: Float[Tensor, "3 4 l 1"]
    cosine: Float[Tensor, "3 4 l 1"]
    slide: Float[Tensor, "3 4 l 1"]
    joint: Int[Tensor, " l"]
    used: Int[Tensor, " u"]
    parent: Int[Tensor, " l"]
    child: Int[Tensor, " j"]
    axis: Float[Tensor, "l 3"]

    def frames(self, values: Float[Tensor, "j n"]) -> Float[Tensor, "3 4 l n"]:
        """Return `root_from_link` of every link without its last row, for the values of all `joint_names`."""
        values = values.index_select(0, self.used)
        by_sine, by_cosine = (x.index_select(0, self.joint) for x in (values.sin(), values.cos()))
        local = torch.addcmul(self.constant.to(values), self.sine.to(values), by_sine)
        local = torch.addcmul(local, self.cosine.to(values), by_cosine)
        if self.slides:
            local = torch.addcmul(local, self.slide.to(values), values.index_select(0, self.joint))
        levels, parents = local.split(self.depths, 2), self.parent.split(self.depths)
        found = list(levels[:2])  # the root is the identity
        for k in range(2, len(levels)):
            above, level = found[-1], levels[k]
            if not self.straight[k]:
                above = above.index_select(2, parents[k])
            frame = above[:, 0, None] * level[0]
            frame = torch.addcmul(frame, above[:, 1, None], level[1])
            frame = torch.addcmul(frame, above[:, 2, None], level[2])
            frame[:, 3] += above[:, 3]
            found.append(frame)
        return torch.stack([found[depth][:, :, place] for depth, place in self.places], 2)

    def poses(self, values: Float[Tensor, "n j"]) -> Float[Tensor, "n l 4 4"]:
        """Return `root_from_link` of every link for the values of every movable joint [rad or m]."""
        frames = self.frames(values.T.contiguous())
        last = frames.new_tensor([0.0, 0.0, 0.0, 1.0])[:, None, None].expand(1, 4, *frames.shape[2:])
        return torch.cat([frames, last]).permute(3, 2, 0, 1)

    def reference_poses(self, values: Float[Tensor, "n j"]) -> Float[Tensor, "n l 4 4"]:
        """Return `poses` by pytorch-kinematics' chain of the same tree, which is good to 1e-8 m."""
        import pytorch_kinematics

        chain: Any = pytorch_kinematics.build_chain_from_urdf(self.xml).to(dtype=values.dtype, device=values.device)
        order = [self.joint_names.index(name) for name in chain.get_joint_parameter_names()]
        poses = chain.forward_kinematics_tensor(values[:, order], analytical_grad=False)
        return poses[[chain.frame_to_idx[name] for name in self.link_names]].transpose(0, 1)


def placed(frames: Float[Tensor, "3 4 p n"], local: Float[Tensor, "p 3"]) -> Float[Tensor, "3 p n"]:
    """Map one point of each frame into the root's."""
    return turned(frames, local) + frames[:, 3]


def turned(frames: Float[Tensor, "3 4 p n"], local: Float[Tensor, "p 3"]) -> Float[Tensor, "3 p n"]:
    """Map one direction of each frame into the root's."""
    x, y, z = local.to(frames)[:, :, None].unbind(1)
    return torch.addcmul(torch.addcmul(frames[:, 0] * x, frames[:, 1], y), frames[:, 2], z)


def kinematics_from_urdf(urdf: Urdf, ends: Collection[str] | None = None) -> Kinematics:
    """Tabulate the tree of a URDF; with `ends`, the part of it that leads to those links."""
    above = {j.child: j for j in urdf.joints}
    kept = {x.name for x in urdf.links} if ends is None else {urdf.root, *ends}
    kept |= {j.parent for end in ends or () for j in urdf.joints_above(end)}
    rows = [[urdf.root]]
    while below := [x.name for x in urdf.links if x.name in kept & set(above) and above[x.name].parent in rows[-1]]:
        rows.append(below)
    names = [name for row in rows for name in row]
    links = [x.name for x in urdf.links if x.name in kept]
    movable = [j for j in urdf.joints if j.kind != "fixed"]
    used = [k for k, j in enumerate(movable) if j.child in kept]
    moved = {movable[k].child: place for place, k in enumerate(used)}
    tables = [_tables(above.get(name)) for name in names]
    constant, sine, cosine, slide = (torch.stack(table, -1)[..., None] for table in zip(*tables, strict=True))
    parents = [[rows[k - 1].index(above[name].parent) if k else 0 for name in row] for k, row in enumerate(rows)]
    axes = [above[name].axis if name in moved else (0.0, 0.0, 0.0) for name in links]
    return Kinematics(
        xml=urdf.kinematic_xml(),
        link_names=tuple(links),
        joint_names=tuple(j.name for j in movable),
        depths=tuple(len(row) for row in rows),
        straight=tuple(row == list(range(len(rows[max(k - 1, 0)]))) for k, row in enumerate(parents)),
        places=tuple(next((k, row.index(name)) for k, row in enumerate(rows) if name in row) for name in links),
        slides=any(movable[k].kind == "prismatic" for k in used),
        constant=constant,
        sine=sine,
        cosine=cosine,
        slide=slide,
        joint=torch.tensor([moved.get(name, 0) for name in names]),
        used=torch.tensor(used, dtype=torch.long),
        parent=torch.tensor([place for row in parents for place in row]),
        child=torch.tensor([links.index(j.child) if j.child in kept else 0 for j in movable], dtype=torch.long),
        axis=torch.tensor(axes, dtype=torch.float64),
    )


def fixed_to(urdf: Urdf, link: str) -> tuple[str, Float[Tensor, "3 4"]]:
    """Return the link that carries another one without a joint that moves between them, and the other's frame in it."""
    above = {j.child: j for j in urdf.joints}
    pose = _tables(None)[0]
    while link in above and above[link].kind == "fixed":
        step = _tables(above[link])[0]
        pose = torch.cat([step[:, :3] @ pose[:, :3], step[:, :3] @ pose[:, 3:] + step[:, 3:]], 1)
        link = above[link].parent
    return link, pose


def _tables(joint: Joint | None) -> list[Float[Tensor, "3 4"]]:
    """Return what the child's frame in the parent's is made of; none: the root's, which is the identity."""
    constant, sine, cosine, slide = torch.zeros(4, 3, 4, dtype=torch.float64).unbind()
    if joint is None:
        constant[:, :3] = torch.eye(3)
        return [constant, sine, cosine, slide]
    turn = rotation_from_rpy(joint.rpy)
    constant[:, :3], constant[:, 3] = turn, torch.tensor(joint.xyz, dtype=torch.float64)
    axis = torch.tensor(joint.axis, dtype=torch.float64)
    if joint.kind == "prismatic":
        slide[:, 3] = turn @ axis
    elif joint.kind == "revolute":  # Rodrigues: I + K sin q + K^2 (1 - cos q), K the cross product with the axis
        cross = skew(axis)
        sine[:, :3], cosine[:, :3] = turn @ cross, -turn @ cross @ cross
        constant[:, :3] -= cosine[:, :3]
    return [constant, sine, cosine, slide]


def ancestor_mask(urdf: Urdf) -> list[list[bool]]:
    """Tell for each link (rows) which movable joints (columns) move it."""
    joints = [j.name for j in urdf.joints if j.kind != "fixed"]
    movers = [{j.name for j in urdf.joints_above(link.name)} for link in urdf.links]
    return [[name in above for name in joints] for above in movers]
