"""Meshes: refusals, closest points of triangles against trimesh, and cuts against areas in closed
form.
"""

import contextlib
import threading

import numpy as np
import pytest
import trimesh

from torchgrasp.foundation.errors import MeshError, SuspiciousScale
from torchgrasp.foundation.limits import MESH_BYTES
from torchgrasp.geometry.mesh import clip_mesh, closest_on_triangles, read_mesh
from torchgrasp.sim.convex_parts import check_parts


def cube(size: float = 0.1) -> trimesh.Trimesh:
    return trimesh.creation.box((size, size, size))


def changed(vertices=lambda x: x, faces=lambda x: x) -> trimesh.Trimesh:
    """A cube with other vertices or faces."""
    return trimesh.Trimesh(
        vertices(np.array(cube().vertices)), faces(np.array(cube().faces)), process=False
    )


def turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A mesh with its faces turned inward."""
    mesh.invert()
    return mesh


def not_finite(vertices):
    vertices[0, 0] = np.nan
    return vertices


def one_turned(faces):
    faces[0] = faces[0, ::-1]
    return faces


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (changed(faces=lambda x: x[:-1]), "open surface"),
        (changed(faces=lambda x: x[:, ::-1]), "volume"),
        (changed(not_finite), "non-finite"),
        (changed(lambda x: x * [1, 1, 0]), "volume"),
        (changed(faces=one_turned), "volume"),
        (
            trimesh.util.concatenate([cube(), turned(cube(0.08)).apply_translation((0.3, 0, 0))]),
            "512 cm.3 turned inward",
        ),
        (
            trimesh.util.concatenate([cube(), turned(cube(0.03)).apply_translation((0.06, 0, 0))]),
            "27 cm.3 turned inward, in no other body",
        ),
        (trimesh.Trimesh(), "of 0 faces"),
    ],
    ids=[
        "open",
        "inside out",
        "not finite",
        "flat",
        "one face turned",
        "one body turned",
        "handle turned",
        "empty",
    ],
)
def test_read_mesh_refuses_what_is_no_body(mesh, reason):
    with pytest.raises(MeshError, match=reason):
        read_mesh(mesh)


@pytest.mark.parametrize("size", [1e-4, 10.0])
def test_meshes_of_another_unit_are_refused_and_a_hollow_body_is_sound(size):
    assert read_mesh(trimesh.util.concatenate([cube(), turned(cube(0.08))])).volume < 0.001
    with pytest.raises(SuspiciousScale, match="use metres"):
        read_mesh(trimesh.creation.box((size, size, 2 * size)))


def test_groups_and_materials_of_an_obj_are_left_out(tmp_path):
    """Their reading took minutes; a corner with two textures made the surface open."""
    box = cube()
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in box.vertices) + "vt 0 0\nvt 1 0\nvt 0 1\n"
    faces = "".join(
        f"o {k}\nusemtl {k}\nf {a + 1}/1 {b + 1}/2 {c + 1}/3\n"
        for k, (a, b, c) in enumerate(box.faces)
    )
    empty = "".join(f"g {k}\nusemtl {k}\n" for k in range(20_000))
    (tmp_path / "box.obj").write_text(f"mtllib /dev/zero\n{corners}{faces}{empty}")
    mesh = read_mesh(tmp_path / "box.obj")
    assert mesh.volume == pytest.approx(0.001) and len(mesh.vertices) == 8


@pytest.mark.promise("H2")
@pytest.mark.parametrize("suffix", [".zip", ".3mf", ".dae", ".gltf", ".xyz", ""])
def test_a_file_that_packs_or_names_others_is_no_mesh(tmp_path, suffix):
    path = tmp_path / f"box{suffix}"
    cube().export(path, file_type="ply")
    with pytest.raises(MeshError, match=r"expected a mesh file \(\.obj.*no such file"):
        read_mesh(path)


def test_bad_files_and_a_mesh_of_a_plane_are_refused(tmp_path):
    with pytest.raises(MeshError, match="no file"):
        read_mesh(tmp_path / "none.ply")
    (tmp_path / "noise.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(MeshError):
        read_mesh(tmp_path / "noise.ply")
    path = tmp_path / "box.ply"
    cube().export(path)
    assert read_mesh(str(path)).volume == pytest.approx(1e-3)
    box = cube()
    lines = [f"v {x} {y}" for x, y, _ in box.vertices] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in box.faces
    ]
    (tmp_path / "flat.obj").write_text("\n".join(lines) + "\n")
    with pytest.raises(MeshError, match="expected "):
        read_mesh(tmp_path / "flat.obj")


@pytest.mark.promise("H2")
def test_negative_indices_of_an_obj_count_back_from_their_line(tmp_path):
    """Two boxes, each written as vertices and then faces."""
    text = ""
    for height in (0.0, 0.07):
        one = trimesh.creation.box((0.05, 0.06, 0.04)).apply_translation((0, 0, height))
        text += "".join("v {:.6f} {:.6f} {:.6f}\n".format(*v) for v in one.vertices)
        text += "".join("f {0}/{0} {1}/{1} {2}/{2}\n".format(*face - 8) for face in one.faces)
    (tmp_path / "boxes.obj").write_text(text)
    mesh = read_mesh(tmp_path / "boxes.obj")
    np.testing.assert_allclose(mesh.bounds[:, 2], [-0.02, 0.09])
    assert mesh.volume == pytest.approx(2 * 0.05 * 0.06 * 0.04)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".off"])
def test_a_box_of_every_format_is_read_and_opens_nothing_else(tmp_path, suffix):
    path = tmp_path / f"box{suffix}"
    opened = []
    content = cube().export(file_type=suffix[1:])
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    if suffix == ".obj":
        path.write_text(f"mtllib ../secret.mtl\nusemtl a\n{path.read_text()}")
        (tmp_path.parent / "secret.mtl").write_text("newmtl a\n")
    read_mesh(path)  # what is imported late is imported now
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "builtins.open",
            lambda file, *at, **by: opened.append(str(file)) or open(file, *at, **by),
        )
        assert read_mesh(path).volume == pytest.approx(1e-3)
    assert set(opened) <= {str(path)}


def test_closest_points_of_triangles_are_those_of_trimesh():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    triangles = rng.normal(size=(500, 3, 3))
    found, feature = closest_on_triangles(points, triangles)
    np.testing.assert_allclose(found, trimesh.triangles.closest_point(triangles, points), atol=1e-9)
    assert set(feature.tolist()) == set(range(7))
    for k in range(3):
        np.testing.assert_allclose(found[feature == 4 + k], triangles[feature == 4 + k, k])


@pytest.mark.parametrize("height", [-0.3, 0.0, 0.61])
def test_a_ball_cut_by_a_plane_keeps_the_area_of_the_cap_and_its_winding(height: float):
    ball = trimesh.creation.icosphere(subdivisions=4)
    vertices, faces, cut = clip_mesh(ball.vertices, ball.faces, ball.vertices[:, 2] - height)
    kept = trimesh.Trimesh(vertices, faces, process=False)
    assert kept.area == pytest.approx(2 * np.pi * (1 + height), rel=0.01)  # Archimedes
    wide = kept.area_faces > 1e-9
    assert (kept.face_normals * kept.triangles_center).sum(1)[wide].min() > 0.9
    assert vertices[:, 2].max() < height + 1e-12
    np.testing.assert_allclose(vertices[cut, 2], height, atol=1e-12)
    box = trimesh.creation.box()
    vertices, faces, cut = clip_mesh(box.vertices, box.faces, -np.ones(8))
    assert len(faces) == 12 and len(vertices) == 8 and not cut.any()
    assert len(clip_mesh(box.vertices, box.faces, np.ones(8))[1]) == 0


@pytest.mark.promise("H5")
def test_a_mesh_or_parts_beyond_the_limits_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = tmp_path / "big.ply"
    with path.open("wb") as file:
        file.truncate(MESH_BYTES + 1)
    with pytest.raises(MeshError, match=f"at most {MESH_BYTES} bytes"):
        read_mesh(path)
    monkeypatch.setattr("torchgrasp.geometry.mesh.MESH_FACES", 11)
    with pytest.raises(MeshError, match="of 12 faces"):
        read_mesh(cube())
    with pytest.raises(MeshError, match="at most 1000"):
        check_parts([trimesh.Trimesh()] * 1001)


def test_what_a_reader_logs_stays_with_it(tmp_path, caplog):
    """A number too many on a line is no fault of the corners; trimesh tells of it with a traceback."""
    text = cube().export(file_type="stl_ascii")
    (tmp_path / "box.stl").write_text(text.replace("normal ", "normal x ", 1))
    with contextlib.suppress(MeshError):
        read_mesh(tmp_path / "box.stl")
    assert not caplog.records


def test_what_other_threads_log_meanwhile_is_kept(tmp_path, caplog, monkeypatch):
    def read_beside_another(*arguments, **options):
        thread = threading.Thread(target=trimesh.util.log.error, args=("of another",))
        thread.start()
        thread.join()
        trimesh.util.log.error("of this")
        return cube()

    monkeypatch.setattr(trimesh, "load_mesh", read_beside_another)
    cube().export(tmp_path / "box.stl")
    read_mesh(tmp_path / "box.stl")
    assert [record.message for record in caplog.records] == ["of another"]


@pytest.mark.parametrize("first", range(6))
def test_a_concave_polygon_whose_notch_is_covered_is_refused(tmp_path, first):
    """A fan from the reflex corner, number 3, or the one across it, covers an L and no more."""
    outline = np.array([(0, 0), (6, 0), (6, 2), (2, 2), (2, 6), (0, 6)]) / 100
    corners = [(x, y, z) for z in (0.0, 0.05) for x, y in outline]
    low = np.roll(np.arange(6), -first)
    faces = [low[[0, 5, 4, 3, 2, 1]], low + 6]
    faces += [[i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += ["f " + " ".join(str(k + 1) for k in face) for face in faces]
    path = tmp_path / "angle.obj"
    path.write_text("\n".join(lines))
    if first in (0, 3):
        # two faces of 20 cm2, and an outline of 24 cm, 5 cm high
        assert read_mesh(path).area == pytest.approx(2 * 0.0020 + 0.24 * 0.05)
    else:
        with pytest.raises(MeshError, match="folded onto other faces"):
            read_mesh(path)
