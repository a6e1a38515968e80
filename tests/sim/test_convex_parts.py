"""Convex parts of a mesh: volumes, cache, refusals."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh

from torchgrasp import load_object
from torchgrasp.foundation.errors import MeshError
from torchgrasp.sim import decompose
from torchgrasp.sim.convex_parts import check_parts, convex_parts, hull


def bracket():
    """A U of three boxes as one closed mesh of the extruded outline."""
    from trimesh.creation import extrude_triangulation

    outline = np.array([[0, 0], [6, 0], [6, 4], [4, 4], [4, 2], [2, 2], [2, 4], [0, 4]]) * 0.01
    triangles = [[0, 1, 4], [0, 4, 5], [0, 5, 6], [0, 6, 7], [1, 2, 3], [1, 3, 4]]
    return extrude_triangulation(outline, np.array(triangles), 0.03)


def test_convex_parts_of_a_convex_mesh_is_its_hull_and_that_of_a_plane_has_no_volume(tmp_path):
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.12)
    parts = convex_parts(mesh, tmp_path)
    assert len(parts) == 1
    assert parts[0].volume == pytest.approx(mesh.volume)
    assert not list(tmp_path.iterdir())
    corners = np.zeros((12, 3))
    corners[0, 0] = -0.016
    corners[10] = (-0.0325, 0.0, -0.0263)
    corners[11] = (-0.0325, 0.0, 0.0263)
    assert hull(corners).volume == 0


def test_convex_parts_fill_a_concave_mesh_and_are_cached(tmp_path, capfd, monkeypatch):
    pytest.importorskip("coacd")
    mesh = bracket()
    parts = convex_parts(mesh, tmp_path)
    assert len(parts) >= 2
    assert all(p.is_convex for p in parts)
    assert sum(p.volume for p in parts) == pytest.approx(mesh.volume, rel=0.1)
    gap = np.array([[0.03, 0.035, 0.015]])
    assert not any(p.contains(gap)[0] for p in parts)
    assert capfd.readouterr().out == ""
    files = list(tmp_path.iterdir())
    assert len(files) == 1
    again = convex_parts(mesh, tmp_path)
    assert len(again) == len(parts)
    for a, b in zip(parts, again, strict=True):
        assert np.array_equal(
            a.vertices, b.vertices
        )  # to the last bit, or a trial would depend on the cache
    good = files[0].read_bytes()
    far = good[:-8] + np.float64(1e20).tobytes()  # its last corner
    cut = [(np.asarray(part.vertices), np.asarray(part.faces)) for part in parts]
    module = sys.modules["torchgrasp.sim.convex_parts"]  # the package has a function of this name
    monkeypatch.setattr(module, "decompose", lambda *_: cut)
    for damaged in (b"damaged", far):
        files[0].write_bytes(damaged)
        assert len(convex_parts(mesh, tmp_path)) == len(parts)
        assert len(files[0].read_bytes()) == len(good) and files[0].read_bytes() not in (
            b"damaged",
            far,
        )


@pytest.mark.sim
def test_decompose_refuses_a_mesh_that_takes_too_long(tmp_path, monkeypatch):
    """The jug takes 4 s; here it has one."""
    pytest.importorskip("coacd")
    monkeypatch.setattr("torchgrasp.sim.decompose.SECONDS", 1.0)
    monkeypatch.setattr("torchgrasp.sim.decompose.SECONDS_PER_FACE", 0.0)
    with pytest.raises(MeshError, match=r"3516 faces that CoACD cannot cut in 1 s"):
        convex_parts(load_object("jug").mesh, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_process_that_decomposes_loads_neither_torch_nor_the_library():
    """What it loads counts towards its limit of memory, and costs its time."""
    code = "import runpy, sys; runpy.run_path(sys.argv[1]); print({'torch', 'torchgrasp'} & set(sys.modules))"
    words = [sys.executable, "-c", code, decompose.__file__]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout == "set()\n"


def dish():
    """A flaring dish of twelve sides, 26 mm high, with a wall of 2 mm."""
    profile = [[0, 0], [42, 0], [60, 26], [58, 26], [40, 2], [0, 2]]
    return trimesh.creation.revolve(np.array(profile) * 1e-3, sections=12)


def test_convex_parts_leave_the_room_in_a_thin_dish_free(tmp_path):
    pytest.importorskip("coacd")
    angle, height = (
        x.ravel() for x in np.meshgrid(np.linspace(0, 6.2, 60), np.linspace(0.003, 0.025, 12))
    )
    # 1.5 mm inside the cone of the inner wall, of which the twelve sides are chords
    radius = (0.040 + 0.75 * (height - 0.002)) * np.cos(np.pi / 12) - 0.0015
    room = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    parts = convex_parts(dish(), tmp_path)
    filled = np.any([part.contains(room) for part in parts], axis=0)
    assert filled.mean() < 0.02


def test_bodies_that_overlap_keep_their_size_and_voids_are_not_filled(tmp_path):
    pytest.importorskip("coacd")
    bar = trimesh.creation.box((0.10, 0.03, 0.03))
    other = trimesh.creation.box((0.03, 0.10, 0.03))
    other.apply_translation((0.035, 0.035, 0.0))
    both = bar + other
    corners = np.concatenate([part.vertices for part in convex_parts(both, tmp_path)])
    assert np.abs(np.stack([corners.min(0), corners.max(0)]) - both.bounds).max() < 1e-6
    void = trimesh.creation.box((0.08, 0.02, 0.02))
    void.invert()
    hollow = trimesh.creation.box((0.1, 0.03, 0.03)) + void
    assert not any(part.contains([[0.0, 0.0, 0.0]])[0] for part in convex_parts(hollow, tmp_path))


def test_check_parts_keeps_convex_parts_and_refuses_others_and_open_meshes():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    assert check_parts([box])[0] is box
    with pytest.raises(MeshError, match="part 0, which is not convex"):
        check_parts([bracket()])
    with pytest.raises(MeshError):
        check_parts([])
    with pytest.raises(MeshError, match="open surface"):
        convex_parts(trimesh.Trimesh(box.vertices, box.faces[:-1]))


def test_convex_parts_of_a_nearly_flat_cube_is_closed(tmp_path):
    """Its hull comes out of Qhull open, and would be refused as a part."""
    cube = trimesh.creation.box([0.04, 0.04, 0.04]).subdivide().subdivide().subdivide()
    noise = np.random.default_rng(0).uniform(-1e-10, 1e-10, cube.vertices.shape)
    cube = trimesh.Trimesh(cube.vertices + noise, cube.faces, process=False)
    assert cube.is_convex and not cube.convex_hull.is_watertight
    (part,) = check_parts(convex_parts(cube, tmp_path))
    assert part.volume == pytest.approx(0.04**3, rel=1e-4)
