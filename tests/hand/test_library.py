"""The hand's chain on its path: pytorch-kinematics itself beside the tables that are compiled from
its tensors.
"""

import functools
import io
from collections.abc import Callable
from typing import Any

import pytest
import torch
import yourdfpy
from pytorch_kinematics import SerialChain
from torch.func import hessian, jacfwd, jacrev, vmap

from tests.make import near
from torchgrasp import Hand, load_hand
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.hand.load import hands_folder
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.testing import random_joints

SHIPPED = sorted(path.parent.name for path in hands_folder().glob("*/hand.toml"))
METHODS = (
    "fingertips",
    "tip_centres",
    "jacobian",
    "link_poses",
    "sphere_centres",
    "self_clearance",
    "check_joints",
)


def library_jacobian(hand: Hand) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return the Jacobian of contact points by the library's serial chains."""
    chains = [SerialChain(hand.chain, link, dtype=hand.chain.dtype) for link in hand.tips.links]
    columns = [
        [hand.tree.joint_names.index(name) for name in x.get_joint_parameter_names()]
        for x in chains
    ]

    def jacobian(joints: torch.Tensor) -> torch.Tensor:
        every = hand.expand_joints(joints)
        moved = []
        for chain, column, contact in zip(chains, columns, hand.tips.contact, strict=True):
            found = chain.jacobian(every[:, column], locations=contact.expand(len(joints), 3))
            moved.append(found[:, :3] @ hand.actuated.coupling[column])
        return torch.stack(moved, 1)

    return jacobian


@pytest.mark.promise("N13")
@pytest.mark.parametrize("name", SHIPPED)
def test_both_backends_place_fingertips_within_a_micrometre_at_1000_postures(name):
    hand = load_hand(name)
    joints = random_joints(hand, 1000)
    (points, normals), (others, directions) = (
        hand.fingertips(joints, x) for x in ("torchgrasp", "pytorch_kinematics")
    )
    near(points, others, 1e-12)
    near(normals, directions, 1e-12)
    near(hand.jacobian(joints), library_jacobian(hand)(joints), 1e-12)
    single = joints[:6].float().reshape(2, 3, hand.dof)
    near(hand.fingertips(single, "pytorch_kinematics")[0], hand.fingertips(single)[0], 1e-6)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_offsets_and_axes_of_the_chain_are_those_that_yourdfpy_reads(name):
    hand = load_hand(name)
    robot = yourdfpy.URDF.load(io.BytesIO(read_urdf(hand.urdf_path).xml), load_meshes=False)
    for joint in robot.robot.joints:
        frame = hand.chain.find_frame(joint.child)
        place = torch.eye(4).double() if joint.origin is None else torch.from_numpy(joint.origin)
        near(frame.joint.offset.get_matrix()[0], place, 1e-15)
        if joint.type != "fixed":
            near(frame.joint.axis, torch.from_numpy(joint.axis), 1e-12)


def test_the_library_is_differentiable_twice_and_refuses_vmap_by_name():
    hand = load_hand("barrett")
    joints = random_joints(hand, 2).requires_grad_()

    def squares(q: torch.Tensor, backend: Any) -> torch.Tensor:
        return sum((x**2).sum() for x in hand.fingertips(q, backend))

    ours, theirs = (
        functools.partial(squares, backend=x) for x in ("torchgrasp", "pytorch_kinematics")
    )
    near(hessian(theirs)(joints[0]), hessian(ours)(joints[0]), 1e-10)
    assert torch.autograd.gradcheck(theirs, joints)
    with pytest.raises(BadArgument, match=r"pytorch_kinematics inside torch\.vmap"):
        vmap(theirs)(joints)


@pytest.mark.parametrize("name", METHODS)
def test_a_first_call_inside_a_transform_leaves_nothing_behind(name):
    """What a hand keeps for later calls is made outside the transform."""
    hand = load_hand("allegro")
    joints = random_joints(load_hand("allegro"), 3)
    action = getattr(hand, name)
    first = (lambda q: action(q)[0]) if name == "fingertips" else action
    jacobian = jacrev(first)(joints[0])
    near(jacfwd(first)(joints[0]), jacobian, 1e-10)
    near(vmap(first)(joints)[0], first(joints[0]), 1e-12)
    near(torch.autograd.functional.jacobian(first, joints[0]), jacobian, 1e-10)


def test_a_moved_hand_has_a_chain_of_its_own():
    hand = load_hand("barrett")
    moved = hand.to(torch.float32)
    again = load_hand("barrett")
    assert (hand.chain.dtype, moved.chain.dtype) == (torch.float64, torch.float32)
    assert hand.chain is not again.chain
    joints = random_joints(hand, 5).float()
    near(moved.fingertips(joints, "pytorch_kinematics")[0], moved.fingertips(joints)[0], 1e-6)


def results(joints: torch.Tensor) -> dict[str, torch.Tensor]:
    """Load a hand, and return its tensors and those of its methods by name."""
    hand = load_hand("barrett")
    found = named_tensors(hand) | {"cone": hand.tips.cone}
    for name in METHODS:
        value = getattr(hand, name)(joints)
        found |= {
            f"{name} {k}": x for k, x in enumerate(value if isinstance(value, tuple) else (value,))
        }
    frames = hand.tree.frames(hand.expand_joints(joints).T.contiguous())
    found |= {f"place {k}": x for k, x in enumerate(hand.motion.place(frames))}
    found |= {f"push {k}": x for k, x in enumerate(hand.self_collision.pushes(frames, 0.01))}
    found["library"] = hand.fingertips(joints, "pytorch_kinematics")[0]
    return found


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_depends_on_the_default_dtype_or_device(dtype):
    joints = random_joints(load_hand("barrett"), 8).to(dtype)
    expected = results(joints)
    torch.set_default_dtype(torch.float64)
    try:
        other = results(joints)
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.device("meta"):  # where a tensor has no numbers
        elsewhere = results(joints)
    for found in (other, elsewhere):
        for name, x in expected.items():
            assert (found[name].dtype, found[name].device) == (x.dtype, x.device), name
            near(found[name], x, 1e-12)


def test_self_clearance_maps_and_differentiates():
    hand = load_hand("leap")
    joints = random_joints(hand, 6, 3)
    for below in (torch.inf, 0.002):
        action = functools.partial(hand.self_clearance, below=below)
        torch.testing.assert_close(vmap(action)(joints), action(joints))
        torch.testing.assert_close(
            vmap(jacrev(action))(joints),
            torch.autograd.functional.jacobian(action, joints).diagonal(dim1=0, dim2=1).T,
        )
    frames = hand.tree.frames(hand.expand_joints(joints).T.contiguous())
    with pytest.raises(BadArgument, match=r"frames: expected .*vmap"):
        vmap(lambda x: hand.self_collision.separations(x, torch.inf), in_dims=3)(frames[..., None])
