"""Household bodies: the same for equal numbers, closed, at rest, and filled by their convex parts."""

import numpy as np
import pytest
import trimesh

pytest.importorskip("manifold3d")

from train.household import FAMILIES, author_household, household
from train.solids import SECTORS, SIDES, find_rest, shell, stack, unite, vessel

from torchgrasp.data import list_views, read_view
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.sim.convex_parts import check_parts

CYCLE = len(FAMILIES)


@pytest.fixture(scope="module")
def bodies():
    """A body of each family."""
    return [author_household(k) for k in range(CYCLE, 2 * CYCLE)]


def polygon(sides: int) -> float:
    """Area of a regular polygon in the unit circle."""
    return sides / 2 * np.sin(2 * np.pi / sides)


def test_a_cycle_has_each_of_more_than_thirty_families(bodies):
    assert {body.family for body in bodies} == set(FAMILIES) and 30 <= CYCLE <= 300
    assert len({body.mesh.volume for body in bodies}) == CYCLE


def test_equal_numbers_give_equal_bodies_and_a_family_draws_anew(bodies):
    again = author_household(CYCLE + 3)
    other = author_household(3)
    assert (again.name, again.family) == (bodies[3].name, other.family)
    assert np.array_equal(again.mesh.vertices, bodies[3].mesh.vertices)
    assert all(
        np.array_equal(a.vertices, b.vertices)
        for a, b in zip(again.parts, bodies[3].parts, strict=True)
    )
    assert not np.allclose(np.sort(other.mesh.extents), np.sort(again.mesh.extents))


def test_each_body_is_one_closed_solid_of_a_graspable_size(bodies):
    for body in bodies:
        assert body.mesh.is_volume and body.mesh.body_count == 1, body.name
        assert body.mesh.extents.min() >= 0.006 and 0.015 <= body.mesh.extents.max() <= 0.25, (
            body.name
        )


def test_each_body_rests_on_the_table_below_its_mass_centre(bodies):
    for body in bodies:
        (x0, y0, low), (x1, y1, _) = body.mesh.bounds
        assert [x0 + x1, y0 + y1, low] == pytest.approx([0, 0, 0], abs=1e-9), body.name
        foot = body.mesh.vertices[
            body.mesh.vertices[:, 2] < 1e-5, :2
        ]  # a hundredth of a millimetre
        centre = body.mesh.center_mass[:2]
        angle = np.linspace(0, 2 * np.pi, 90)
        ahead = np.stack([np.cos(angle), np.sin(angle)])
        assert (((foot - centre) @ ahead).max(0) > 0).all(), (
            body.name
        )  # no line parts it from its feet


def depths(points: np.ndarray, part: trimesh.Trimesh) -> np.ndarray:
    """How far each point is beyond the planes of a part's faces, negative inside."""
    offsets = (part.face_normals * part.triangles[:, 0]).sum(-1)
    return (points @ part.face_normals.T - offsets).max(1)


def test_the_parts_are_what_a_simulator_takes(bodies):
    for body in bodies:
        assert 1 <= len(body.parts) <= 64, body.name
        assert max(len(part.vertices) for part in body.parts) <= 48, body.name
        assert max(depths(part.vertices, part).max() for part in body.parts) < 1e-9, body.name
    assert all(check_parts(body.parts) for body in bodies[::12])


def test_the_union_of_the_parts_is_the_mesh(bodies):
    for body in bodies:
        points = np.random.default_rng(0).uniform(*body.mesh.bounds, (200, 3))
        depth = np.min([depths(points, part) for part in body.parts], 0)
        clear = abs(depth) > 1e-6  # single precision of the rays that `contains` casts
        assert np.array_equal(body.mesh.contains(points)[clear], depth[clear] < 0), body.name


def test_parts_that_do_not_overlap_have_the_volume_of_the_mesh():
    frustum, _ = unite(stack([(20, 0), (30, 60)]))
    assert frustum.volume * 1e9 == pytest.approx(polygon(SIDES) * 60 / 3 * (400 + 600 + 900))
    for thing in (
        shell([(30, 25, 0), (30, 25, 50)]),
        vessel([(30, 0), (30, 50)], 5, 10),
        stack([(9, 0), (20, 5), (6, 8)]),
    ):
        mesh, parts = unite(thing)
        assert mesh.volume == pytest.approx(sum(part.volume for part in parts))
    ring = polygon(2 * SECTORS) * 900 - polygon(SECTORS) * 625
    assert unite(shell([(30, 25, 0), (30, 25, 50)]))[0].volume * 1e9 == pytest.approx(50 * ring)


def test_a_tilted_box_comes_to_rest_on_its_nearest_steady_face():
    box = trimesh.creation.box((0.1, 0.1, 0.004))
    tilted = box.copy().apply_transform(trimesh.transformations.rotation_matrix(1.5, (1, 0, 0)))
    for body in (box, tilted):  # its narrow side is no steady face
        assert body.copy().apply_transform(find_rest(body)).extents[2] == pytest.approx(0.004)


def test_a_folder_of_bodies_reads_back_with_its_view(tmp_path):
    household(tmp_path, 1, first=5)
    body = author_household(5)
    assert (
        list_views(tmp_path) == [(body.name, "view0")]
        and len(read_view(tmp_path, body.name, "view0")) > 100
    )
    assert read_mesh(tmp_path / body.name / "mesh.ply").volume == pytest.approx(
        body.mesh.volume, rel=1e-4
    )
