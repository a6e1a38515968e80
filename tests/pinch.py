"""A standing cylinder and a pinch of it by each hand, solved once: what tests of trials and
simulators start from.
"""

import dataclasses
import functools
import hashlib

import pytest
import torch
import trimesh

from tests.apart import run_apart
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.geometry.frames import rigid, rotate, rotation_from_vector
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.load import load_hand
from torchgrasp.values.planning import Certificate, Contacts, Grasps
from torchgrasp.values.specs import TrialSpec

RADIUS = 0.03
HEIGHT = 0.18
POSES = {  # rotation vector, translation, joints, opened joints
    "allegro": (
        [0.24253, -1.75703, -2.50589],
        [0.1042, 0.014, 0.0964],
        [
            -0.0667,
            0.6228,
            0.6892,
            0.557,
            0.0044,
            0.7411,
            0.7659,
            0.5881,
            1.1233,
            0.4317,
            0.4032,
            0.6257,
        ],
        [
            -0.1367,
            0.6075,
            0.5415,
            0.4525,
            -0.0493,
            0.6581,
            0.6872,
            0.5489,
            1.0773,
            0.5813,
            0.1806,
            0.8404,
        ],
    ),
    "barrett": (
        [-3.12917, -0.02668, 0.00548],
        [0.0007, -0.0085, 0.3262],
        [0.0004, 1.231, 1.2386, 1.2678],
        [0.1918, 1.1228, 1.1304, 1.1384],
    ),
}
CONTACTS = {
    "allegro": ([[0, 1, 0], [0, 1, 0], [0, -1, 0]], [0.1485, 0.1035, 0.126]),
    "barrett": ([[-0.6311, 0.7757, 0], [0.6311, 0.7757, 0], [0, -1, 0]], [0.15, 0.15, 0.15]),
}
QUICK = TrialSpec(hold_time=0.1, control_rate=50.0)


def cylinder(shift=(0.0, 0.0)):
    mesh = trimesh.creation.cylinder(radius=RADIUS, height=HEIGHT)
    mesh.apply_translation([*shift, HEIGHT / 2])
    return mesh


@functools.cache
def pinch(name):
    """The hand and its grasp of the cylinder."""
    real = {"dtype": torch.float64}
    vector, translation, joints, opened = (torch.tensor([v], **real) for v in POSES[name])
    normals, heights = (torch.tensor(v, **real) for v in CONTACTS[name])
    normals = normals / normals.norm(dim=-1, keepdim=True)
    points = RADIUS * normals + heights[:, None] * torch.tensor([0.0, 0.0, 1.0], **real)
    one = torch.ones(1, **real)
    three = torch.ones(1, 3, **real)
    hand = load_hand(name)
    pose = rigid(rotation_from_vector(vector), translation)
    return hand, Grasps(
        joints=joints,
        pregrasp=opened,
        approach=rotate(pose, hand.approach[None].double())[:, 0],
        obj_from_hand=pose,
        contacts=Contacts(points[None], normals[None], std_m=0.004 * three),
        permutation=torch.tensor([[0, 1, 2]]),
        tip_error=0 * three,
        clearance=0.01 * one,
        normal_angle=0 * three,
        certificate=Certificate(one, one, 0 * one, torch.tensor([True]), torch.zeros(1, 6)),
        score=one,
        status=torch.zeros(1, dtype=torch.int64),
        meta={"hand": name, "table": Plane.horizontal(0.0).describe()},
    )


def close(name, mesh=None, spec=None, **options):
    pytest.importorskip("sapien")
    hand, grasp = pinch(name)
    return close_hand(grasp, hand, cylinder() if mesh is None else mesh, spec, **options)


@functools.cache
def quick_trial(name="allegro", simulator="sapien"):
    """The trial of a cylinder that stands where it was planned, simulated once for all tests."""
    return close(name, spec=dataclasses.replace(QUICK, simulator=simulator))


def digest(result):
    """Every number of a trial but its wall time."""
    tensors = (getattr(result, f.name) for f in dataclasses.fields(result))
    data = b"".join(t.numpy().tobytes() for t in tensors if isinstance(t, torch.Tensor))
    return hashlib.sha256(
        data + repr((result.status, result.object_motion, result.contact_order)).encode()
    ).hexdigest()


@functools.cache
def digests_elsewhere(name, simulators, seed):
    """The digests of quick trials in each of the simulators, in one process of its own."""
    code = (
        "import dataclasses, warnings; warnings.simplefilter('ignore'); from tests.pinch import QUICK, close, digest\n"
        f"for simulator in {simulators!r}:\n"
        "    spec = dataclasses.replace(QUICK, simulator=simulator)\n"
        f"    print(digest(close({name!r}, spec=spec, seed={seed})))"
    )
    (said,) = run_apart(code)
    return dict(zip(simulators, said.split(), strict=True))
