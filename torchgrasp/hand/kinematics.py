"""Forward kinematics of a URDF tree: the one place that talks to pytorch-kinematics.

pytorch-kinematics ignores `<mimic>`, so it is given every joint's value; it builds offsets in float32, which leaves
about 1e-8 m; its `.to()` works in place and keeps indices on the old device, so each device and dtype has a chain of
its own here; its analytical backward is wrong in second derivatives, so plain autograd is used.
"""

import dataclasses
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.hand.urdf import Urdf


@dataclasses.dataclass(frozen=True, eq=False)
class Kinematics:
    """The tree of a URDF: link and joint names, and chains for the dtypes and devices met so far."""

    xml: bytes
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    chains: dict[tuple[torch.dtype, torch.device], Any] = dataclasses.field(default_factory=dict, repr=False)

    def poses(self, values: Float[Tensor, "n j"]) -> Float[Tensor, "n l 4 4"]:
        """Return `root_from_link` of every link for the values of every movable joint [rad or m]."""
        key = (values.dtype, values.device)
        if key not in self.chains:
            import pytorch_kinematics

            chain = pytorch_kinematics.build_chain_from_urdf(self.xml).to(dtype=values.dtype, device=values.device)
            order = [self.joint_names.index(n) for n in chain.get_joint_parameter_names()]
            frames = [chain.frame_to_idx[n] for n in self.link_names]
            index = (torch.tensor(x, device=values.device) for x in (order, frames))
            self.chains[key] = (chain, *index)
        chain, order, frames = self.chains[key]
        poses = chain.forward_kinematics_tensor(values[:, order], analytical_grad=False)
        return poses[frames].transpose(0, 1)


def kinematics_from_urdf(urdf: Urdf) -> Kinematics:
    """Name the links and the movable joints of a URDF, in the order of the file."""
    joints = tuple(j.name for j in urdf.joints if j.kind != "fixed")
    return Kinematics(urdf.kinematic_xml(), tuple(x.name for x in urdf.links), joints)


def ancestor_mask(urdf: Urdf) -> list[list[bool]]:
    """Tell for each link (rows) which movable joints (columns) move it."""
    joints = [j.name for j in urdf.joints if j.kind != "fixed"]
    movers = [{j.name for j in urdf.joints_above(link.name)} for link in urdf.links]
    return [[name in above for name in joints] for above in movers]
