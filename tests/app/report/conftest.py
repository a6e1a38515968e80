"""A run made of simple solids: a box that was seen, three contacts on it, a hand beside it, a
closure that lifts it.
"""

import math
from pathlib import Path

import pytest
import torch
import trimesh

from torchgrasp.app.report.run_data import Run
from torchgrasp.foundation.errors import Status
from torchgrasp.hand.load import load_hand
from torchgrasp.shape.surface import Surface
from torchgrasp.values.closing import ClosingTrace, ClosureResult, Disturbance, ObjectMotion
from torchgrasp.values.planning import Certificate, ContactPlan, Contacts, Grasps, PointCloud
from torchgrasp.values.specs import ContactSpec

F64 = torch.float64


@pytest.fixture(scope="session")
def run() -> Run:
    hand = load_hand("allegro")
    body = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    vertices = torch.tensor(body.vertices.copy(), dtype=F64)
    normals = vertices / 0.03
    faces = torch.tensor(body.faces.copy(), dtype=torch.int64)
    surface = Surface(vertices, faces, normals, 0.002 + 0.1 * vertices[:, 0].abs())
    angles = torch.tensor([0.0, 2.0, 4.0], dtype=F64)
    out = (
        torch.stack([angles.cos(), angles.sin(), torch.zeros(3, dtype=F64)], -1)
        .expand(2, 3, 3)
        .clone()
    )
    small = torch.full((2, 3), 1e-3, dtype=F64)
    contacts = Contacts(0.03 * out, out, std_m=small)
    one = torch.ones(2, dtype=F64)
    joints = ((hand.lower + hand.upper) / 2).to(F64).expand(2, -1).clone()
    pose = torch.eye(4, dtype=F64).repeat(2, 1, 1)
    pose[:, 2, 3] = 0.1
    certificate = Certificate(0.02 * one, 0.3 * one, 1e-12 * one, one > 0, torch.zeros(2, 6))
    status = torch.tensor([Status.OK, Status.TIP_ERROR])
    meta = {
        "hand": "allegro",
        "hand_sha256": hand.source.sha256,
        "seed": "7",
        "units": "metre, radian",
        "note": "<script>alert(1)</script>",
    }
    order = torch.tensor([[0, 1, 2], [2, 1, 0]])
    grasps = Grasps(
        joints,
        joints,
        out[:, 0],
        pose,
        contacts,
        order,
        0.2 + small,  # the hand is beside the ball
        0.004 * one,
        math.pi * small,
        certificate,
        one,
        status,
        meta,
    )
    steps = 5
    time = torch.linspace(0, 1, steps, dtype=F64)
    lifted = torch.eye(4, dtype=F64).repeat(steps, 1, 1)
    lifted[:, 2, 3] = 0.1 * time
    held = pose[:1] @ lifted
    closure = ClosureResult(
        held=True,
        status=Status.OK,
        time=time,
        forces=time[:, None].expand(steps, 3).clone(),
        object_pose=lifted,
        hand_pose=held,
        joints=hand.expand_joints(joints[:1]).expand(steps, -1).clone(),
        targets=hand.expand_joints(joints[:1]).expand(steps, -1).clone(),
        joint_names=hand.tree.joint_names,
        contact_order=(0, 1, 2),
        object_motion=ObjectMotion(0.003, math.radians(2)),
        pushed=ObjectMotion(0.002, 0.0),
        before_lift=ObjectMotion(0.002, 0.0),
        rise=0.1,
        unbalanced=0.1,
        slip=ObjectMotion(0.001, 0.0),
        start_overlap=0.0,
        disturbance=Disturbance(
            torch.full((3,), math.inf),
            *torch.zeros(2, 3),
            torch.zeros(3, dtype=torch.bool),
            lifted[:, None],
        ),
        trace=ClosingTrace(
            *torch.zeros(3, steps, 3, 3, dtype=F64),
            torch.zeros(steps, 3, dtype=F64),
            time[:, None].expand(steps, 3).clone(),
            *torch.full((2, steps), math.nan, dtype=F64),
        ),
        phases=torch.tensor([0.0, 0.5, 0.75], dtype=F64),
        stops=0,
        attempts=1,
        seconds=1.0,
    )
    cloud = PointCloud(vertices[vertices[:, 0] > 0], None, torch.tensor([0.5, 0.1, 0.3], dtype=F64))
    failed = torch.tensor([Status.NOT_CLOSED, Status.NOT_CLOSED])
    plan = ContactPlan(contacts, torch.ones(2, 3, 8, dtype=F64), one, failed)
    stages = (("cloud", "321 points", 0.1), ("shape", "a <b>bold</b> claim", 1.25))
    source = Path("clouds/<odd> & 'quoted'.ply")
    return Run(
        "ball",
        source,
        cloud,
        hand,
        ContactSpec(table=-0.03),
        surface,
        grasps,
        stages,
        plan,
        body,
        closure,
    )
