"""The bench of streams: its clock, its peer's derivatives and weight, and that every subject prints its rows."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
import trimesh
from benchmarks.anytime import memory, suite
from benchmarks.anytime.before import bench_before
from benchmarks.anytime.course import Course
from benchmarks.anytime.peers import start_of, starts_of
from benchmarks.anytime.single_start import least_weight

from tests.pinch import pinch
from torchgrasp import ContactSpec, certify, load_hand, load_object
from torchgrasp.base import join
from torchgrasp.ik.candidates import measure_errors

SPEC = ContactSpec(table=0.0)


@pytest.fixture
def folder(tmp_path):
    """A ball on a table, seen from one side."""
    pose, shift = np.eye(4), np.array([0.0, 0.0, 0.04])
    pose[:3, 3] = [0.5, 0.0, 0.3]
    (tmp_path / "ball").mkdir()
    mesh = trimesh.creation.icosphere(3, 0.04).apply_translation(shift)
    mesh.export(tmp_path / "ball" / "mesh.ply")
    seen = mesh.vertices[(mesh.vertices - shift) @ (pose[:3, 3] - shift) > 2e-3]
    trimesh.PointCloud(seen).export(tmp_path / "ball" / "view0_noisy.ply")
    entry = {"views": {"view0": {"T_object_camera": pose.tolist()}}, "family": "ball", "mass_kg": 0.1}
    (tmp_path / "manifest.json").write_text(json.dumps({"objects": {"ball": entry}}))
    return tmp_path


@pytest.fixture(scope="module")
def peer():
    """The first search of the peer on the shipped tin."""
    view, hand = load_object("cylinder").view, load_hand("allegro")
    problem, seeds, shape, spec = starts_of(view, hand, SPEC, 2)
    return start_of(problem, seeds, shape, spec, 0)


def test_a_course_tells_what_had_come_by_when():
    _, grasp = pinch("allegro")
    good, better = (dataclasses.replace(grasp, score=torch.full_like(grasp.score, x)) for x in (0.0, 2.0))
    course = Course(((0.5, join([good, good])), (1.5, better)), 2.0)
    assert course.until(0.4) is None and course.executable == 3
    assert [course.time_of(n) for n in (1, 2, 3, 4)] == [0.5, 0.5, 1.5, math.inf]
    assert course.best(1.0) == pytest.approx(0.5) and course.best(1.5) == pytest.approx(1 / (1 + math.exp(-2)))
    assert course.best(1.0, 4) == pytest.approx(0.25)


def test_the_weight_is_the_margin_of_the_certificate(peer):
    points, normals = peer.points, peer.shape.predict(peer.points).normal
    contacts = peer.contacts(np.concatenate([np.zeros(6 + peer.hand.dof), peer.shape.normalise(points).flatten()]))
    count = 3 * SPEC.edges
    found = least_weight(peer.spec, points, normals)
    assert -float(found) == pytest.approx(count * float(certify(contacts, peer.spec).margin), rel=1e-6)


def test_the_derivatives_of_the_peer_are_finite_differences(peer):
    generator = np.random.default_rng(0)
    middle = (peer.hand.lower + peer.hand.upper).numpy() / 2
    points = peer.shape.normalise(peer.points).flatten().numpy()
    x = np.concatenate([0.1 * generator.normal(size=6), middle, points + 0.02 * generator.normal(size=points.size)])
    at, step = peer.evaluate(x), 1e-6
    ends = [[peer.evaluate(x + s * e) for s in (step, -step)] for e in np.eye(x.size)]
    for values, derivative in (("cost", "by_cost"), ("off", "by_off"), ("room", "by_room")):
        numeric = np.array([np.subtract(*(getattr(end, values) for end in pair)) / (2 * step) for pair in ends]).T
        np.testing.assert_allclose(getattr(at, derivative), numeric, atol=1e-4)


def test_the_peer_finds_a_grasp_that_satisfies_the_checks(peer):
    found = peer.search()
    assert found is not None
    configuration, contacts = found
    assert bool(certify(contacts, peer.spec).closed)
    assert int(measure_errors(peer.hand, configuration, contacts, peer.world).status) == 0


def test_subjects_print_their_rows(folder, tmp_path, capsys, monkeypatch):
    """Of a stream that is known beforehand."""
    _, grasp = pinch("allegro")
    course = Course(((0.5, grasp), (1.5, join([grasp] * 49))), 2.0)
    monkeypatch.setattr(suite, "watch", lambda *arguments: course)
    out = tmp_path / "out.json"
    suite.anytime(folder, ("stream", "peers"), views=1, hand="barrett", tries=1, out=out)
    rows = {row["what"].split(",")[0]: row for row in json.loads(out.read_text())["rows"]}
    assert rows["first executable grasp"]["met"] and rows["fifty executable grasps"]["met"]
    assert rows["all of the work"]["numbers"] == {"seconds": [2.0], "executable": [50]}
    assert rows["our whole call"]["numbers"] == {"whole": 0.04}
    assert "feasible" in capsys.readouterr().out


def test_memory_is_that_of_a_process_of_its_own(folder):
    ballast = torch.ones(100_000_000)  # 400 MB of this process
    (row,) = memory.bench_memory(folder, [("ball", "view0")], "barrett", (20,))
    assert 100 < row.numbers["20"][0] < 1000 and len(ballast)


def test_another_checkout_must_be_named():
    with pytest.raises(SystemExit, match="--before"):
        bench_before([], [], "barrett", 20, None)
