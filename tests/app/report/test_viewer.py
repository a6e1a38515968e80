import base64
import dataclasses
import hashlib
import json
import re

import numpy as np
import pytest
import torch
import trimesh

from tests.make import random_motion
from torchgrasp.app.report.page import format_page
from torchgrasp.app.report.run_data import VIEW
from torchgrasp.app.report.solids import EDGE, round_shape, solids_from_hand, solids_of_links
from torchgrasp.app.report.viewer import (
    POSTURES,
    VIEWER,
    describe,
    format_viewer,
    thin_mesh,
    three,
)
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.hand.urdf import LinkShape
from torchgrasp.ik.motion import APPROACH_DISTANCE
from torchgrasp.values.closing import ClosingTrace


def unpack(buffer):
    values = np.frombuffer(base64.b64decode(buffer["data"]), f"<{buffer['kind']}")
    return values.reshape(buffer["shape"])


def data_of(page):
    (text,) = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL
    )
    return json.loads(text)


def posed(pieces, poses):
    """The points of all pieces of a hand at the poses of its links, worked out as the page does."""
    parts = [
        unpack(p["points"]) @ poses[p["link"], :3, :3].T + poses[p["link"], :3, 3] for p in pieces
    ]
    return np.concatenate(parts)


def test_buffers_hold_the_surface_the_cloud_and_the_contacts_of_the_run(run):
    seen = data_of(format_viewer(run))
    upright = run.upright()
    for name, expected in (
        ("points", upright.surface.vertices),
        ("normals", upright.surface.normals),
        ("std", upright.surface.std_m),
        ("faces", upright.surface.faces),
    ):
        np.testing.assert_allclose(unpack(seen["surface"][name]), expected, atol=1e-7)
    np.testing.assert_allclose(unpack(seen["cloud"]), upright.cloud.points, atol=1e-7)
    best = upright.executable
    np.testing.assert_allclose(unpack(seen["grasps"]["points"]), best.contacts.points, atol=1e-7)
    np.testing.assert_allclose(unpack(seen["grasps"]["normals"]), best.contacts.normals, atol=1e-7)
    assert seen["grasps"]["rows"] == [["1", "73%", "0.0200", "4.0", "1.0"]]
    colors = unpack(seen["surface"]["colors"])
    std = unpack(seen["surface"]["std"])
    darkest = colors[std.argmin()].astype(int)
    brightest = colors[std.argmax()].astype(int)
    assert (
        brightest.sum() > darkest.sum() + 100 and seen["surface"]["ramp"][-1] == brightest.tolist()
    )


def test_an_upright_run_has_its_table_and_edge_in_its_own_frame(run):
    motion = random_motion(2)
    table = Plane.horizontal(-0.03).ending(real([0.01, 0.0, 0.0]), real([1.0, 0.5, 0.0]))
    given = table.moved(motion)
    grasps = move(run.grasps, motion)
    there = dataclasses.replace(
        run,
        cloud=move(run.cloud, motion),
        surface=move(run.surface, motion),
        grasps=dataclasses.replace(grasps, meta=grasps.meta | {"table": given.describe()}),
        spec=dataclasses.replace(run.spec, table=given),
        mesh=None,
        closure=None,
    )
    upright = there.upright()
    room = table.clearance(run.surface.vertices)
    for found in (upright.spec.plane, upright.grasps.table):
        torch.testing.assert_close(
            found.clearance(upright.surface.vertices), room, atol=1e-5, rtol=0
        )
    *normal, offset = describe(there)["edge"]
    beyond = upright.surface.vertices @ real(normal) - offset
    torch.testing.assert_close(beyond, table.edge.height(run.surface.vertices), atol=1e-5, rtol=0)
    assert describe(run)["edge"] is None


def test_the_hand_stands_where_the_stills_draw_it_and_approaches_along_its_path(run):
    upright = run.upright()
    seen = describe(run)
    poses = unpack(seen["grasps"]["links"]).astype(float)[0]
    best = upright.executable
    joints = run.hand.expand_joints(best.joints[0].double())
    solids = solids_from_hand(run.hand, joints, run.hand.tree.joint_names, best.obj_from_hand[0])
    expected = np.concatenate([s.vertices for s in solids])
    np.testing.assert_allclose(
        posed(seen["hand"], poses[POSTURES.index("grasp")]), expected, atol=1e-6
    )
    approach, pregrasp = (
        posed(seen["hand"], poses[POSTURES.index(name)]) for name in ("approach", "pre-grasp")
    )
    step = APPROACH_DISTANCE * best.approach[0].numpy()
    np.testing.assert_allclose(
        pregrasp - approach, np.broadcast_to(step, approach.shape), atol=1e-6
    )
    squeezed = posed(seen["hand"], poses[POSTURES.index("squeeze")])
    assert 1e-4 < np.abs(squeezed - expected).max() < 0.1


def test_the_replay_moves_the_true_object_as_the_closure_did(run):
    replay = describe(run)["replay"]
    closure = run.upright().closure
    ticks = unpack(replay["ticks"]).tolist()
    np.testing.assert_allclose(unpack(replay["object"]), closure.object_pose[ticks], atol=1e-7)
    np.testing.assert_allclose(unpack(replay["forces"]), closure.forces, atol=1e-6)
    first, last = (
        posed(describe(run)["hand"], unpack(replay["links"])[k].astype(float)) for k in (0, -1)
    )
    np.testing.assert_allclose(
        last - first, np.broadcast_to([0.0, 0.0, 0.1], first.shape), atol=1e-6
    )


def test_the_film_says_which_grasp_it_is_and_names_its_moments(run):
    replay = describe(run)["replay"]
    assert replay["grasp"] == 1 and replay["story"].startswith(
        "In the order of touch: index, middle, thumb."
    )
    assert [tick for tick, _ in replay["moments"]] == sorted(tick for tick, _ in replay["moments"])
    assert replay["moments"][-1] == (4, "the end")


def test_forces_stand_at_the_contacts_in_the_frame_of_the_page(run):
    """Turned by a right angle about z and lifted: what the hand feels along its x acts along the
    page's y.
    """
    turned = torch.tensor(
        [[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]], dtype=torch.float64
    )
    trace = dataclasses.replace(
        run.closure.trace,
        points=torch.tensor([0.1, 0.0, 0.0]).double().expand(5, 3, 3),
        forces=torch.tensor([2.0, 0.0, 1.0]).double().expand(5, 3, 3),
    )
    closure = dataclasses.replace(run.closure, hand_pose=turned.expand(5, 4, 4), trace=trace)
    frame = np.array(describe(run)["frame"])
    replay = describe(dataclasses.replace(run, closure=closure))["replay"]
    point = frame @ [0.0, 0.1, 0.2, 1.0]
    force = frame[:3, :3] @ [0.0, 2.0, 1.0]
    np.testing.assert_allclose(unpack(replay["touches"])[3, 1], point[:3], atol=1e-6)
    np.testing.assert_allclose(unpack(replay["pushes"])[3, 1], force, atol=1e-6)


def test_sensors_and_the_frame_of_the_file_are_where_the_cloud_says(run):
    seen = describe(run)
    frame = np.array(seen["frame"])
    np.testing.assert_allclose(
        seen["sensors"], [frame[:3, :3] @ [0.5, 0.1, 0.3] + frame[:3, 3]], atol=1e-9
    )
    points = run.cloud.points.numpy() @ frame[:3, :3].T + frame[:3, 3]
    np.testing.assert_allclose(unpack(seen["cloud"]), points, atol=1e-6)
    blind = dataclasses.replace(run, cloud=dataclasses.replace(run.cloud, viewpoint=None))
    assert describe(blind)["sensors"] == []


def test_a_long_run_is_thinned_to_what_a_page_holds(run):
    ticks = 1000
    rows = torch.arange(ticks) % len(run.closure.time)
    long = {
        name: getattr(run.closure, name)[rows]
        for name in ("forces", "object_pose", "hand_pose", "joints", "targets")
    }
    trace = ClosingTrace(
        *(getattr(run.closure.trace, f.name)[rows] for f in dataclasses.fields(ClosingTrace))
    )
    closure = dataclasses.replace(
        run.closure, time=torch.arange(ticks).double(), trace=trace, **long
    )
    many = run.grasps[torch.zeros(50, dtype=torch.int64)]
    fine = trimesh.creation.icosphere(subdivisions=6, radius=0.03)
    page = format_viewer(dataclasses.replace(run, closure=closure, grasps=many, mesh=fine))
    seen = data_of(page)
    assert (
        seen["replay"]["ticks"]["shape"] == [VIEWER.ticks]
        and unpack(seen["replay"]["ticks"])[-1] == ticks - 1
    )
    assert (
        seen["replay"]["forces"]["shape"] == [ticks, 3]
        and len(seen["grasps"]["rows"]) == VIEWER.grasps
    )
    assert seen["replay"]["faces"]["shape"][0] <= VIEWER.faces < len(fine.faces)
    assert len(page) < 8 * 2**20


def test_thinned_meshes_keep_their_shape():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    kept, faces = thin_mesh(ball.vertices, ball.faces, 2000)
    thinned = trimesh.Trimesh(ball.vertices[kept], faces, process=False)
    assert 500 < len(faces) <= 2000
    assert thinned.area == pytest.approx(4 * np.pi, rel=0.1)
    assert abs(thinned.volume) == pytest.approx(4 / 3 * np.pi, rel=0.1)
    same, untouched = thin_mesh(ball.vertices, ball.faces, len(ball.faces))
    assert np.array_equal(untouched, ball.faces) and len(same) == len(ball.vertices)


def test_the_page_loads_nothing_and_runs_its_own_scripts_alone(run):
    odd = dataclasses.replace(run, object_name="</script><b>jug</b><!--")
    page = format_viewer(odd)
    rest = page.replace(three(), "")
    assert not re.findall(r"https?://|\bimport\(|@import|<b>jug", rest)
    assert re.findall(r'(?:src|href)="([^"]*)"', rest) == ["data:,"]
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert (
        policy.startswith("default-src 'none';")
        and "unsafe-eval" not in policy
        and "connect-src" not in policy
    )
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy
    assert len(scripts) == 2 and "\r" not in page
    assert data_of(page)["title"] == "Grasps of the </script><b>jug</b><!-- with the allegro hand"


def test_a_run_without_grasps_or_closure_has_a_page(run):
    failed = dataclasses.replace(run.grasps, status=torch.full((2,), int(Status.TIP_ERROR)))
    seen = describe(dataclasses.replace(run, grasps=failed, closure=None, mesh=None))
    assert seen["replay"] is None and seen["grasps"]["rows"] == [] and not seen["good"]


def test_the_report_links_to_the_page_only_where_there_is_one(run):
    assert f'href="{VIEW}"' in format_page(run, {}, VIEW) and VIEW not in format_page(run, {})


@pytest.mark.parametrize(
    ("kind", "size"), [("box", (0.02, 0.05, 0.1)), ("cylinder", (0.01, 0.04)), ("sphere", (0.012,))]
)
def test_rounded_shapes_fill_their_shape_but_for_the_edges(kind, size):
    place = {"xyz": (0.1, -0.2, 0.3), "rpy": (0.4, 0.5, 0.6)}
    vertices, solid_faces, normals = round_shape(LinkShape(kind, size, **place))
    sharp = {
        "box": lambda: trimesh.creation.box(size),
        "cylinder": lambda: trimesh.creation.cylinder(*size, sections=40),
        "sphere": lambda: trimesh.creation.icosphere(4, *size),
    }[kind]()
    matrix = trimesh.transformations.euler_matrix(*place["rpy"], axes="sxyz")
    matrix[:3, 3] = place["xyz"]
    local = (vertices - matrix[:3, 3]) @ matrix[:3, :3]
    mesh = trimesh.Trimesh(local, solid_faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert 0.85 * sharp.volume < mesh.volume <= sharp.volume * 1.01
    np.testing.assert_allclose(np.ptp(local, axis=0), sharp.extents, atol=1e-3 * EDGE)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    faces = mesh.face_normals
    inner = normals[solid_faces] @ matrix[:3, :3]
    assert (np.einsum("fci,fi->fc", inner, faces) > 0.8).all()


def test_solids_of_links_are_those_of_the_hand_at_rest(run):
    hand = run.hand
    poses = hand.tree.poses(torch.zeros(1, len(hand.tree.joint_names), dtype=torch.float64))[
        0
    ].numpy()
    solids = solids_from_hand(
        hand, torch.zeros(len(hand.tree.joint_names)), hand.tree.joint_names, torch.eye(4)
    )
    for here, there in zip(solids_of_links(hand), solids, strict=True):
        pose = poses[here.link]
        np.testing.assert_allclose(
            here.vertices @ pose[:3, :3].T + pose[:3, 3], there.vertices, atol=1e-12
        )
