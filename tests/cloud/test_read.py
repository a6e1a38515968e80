import contextlib
import io
import struct
import zipfile

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.cloud.pcd import decompress
from torchgrasp.cloud.read import cloud_from_array, read_cloud, read_cloud_file, save_cloud
from torchgrasp.files.columns import read_lines
from torchgrasp.foundation.errors import (
    BadArgument,
    CloudFileError,
    CloudWarning,
    GraspError,
    OutputError,
    SuspiciousScale,
    TooFewPoints,
)
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.planning import PointCloud


@pytest.fixture
def points():
    """On a sphere, whose normals are `unit_rows`."""
    return 0.04 * unit_rows(60)


def unit_rows(n):
    v = np.random.default_rng(1).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.mark.parametrize(
    "fields", ["points", "points normals", "points viewpoint", "points normals viewpoint frustum"]
)
@pytest.mark.parametrize(("suffix", "tolerance"), [(".npz", 0.0), (".ply", 1e-8)])
def test_a_saved_cloud_reads_back(tmp_path, points, fields, suffix, tolerance):
    arrays = {"points": points, "normals": unit_rows(60), "viewpoint": np.array([0.1, -0.2, 0.7])}
    arrays["frustum"] = unit_rows(4)
    cloud = PointCloud(**{name: torch.from_numpy(arrays[name]) for name in fields.split()})
    back = read_cloud(save_cloud(cloud, tmp_path / f"cloud{suffix}"))
    for name in arrays:
        wanted = getattr(cloud, name)
        found = getattr(back, name)
        assert (wanted is None) == (found is None)
        if wanted is not None:
            assert found.dtype == torch.float64
            # float32 of the file: relative 6e-8
            assert (wanted - found).abs().max() <= tolerance * (10 if name == "normals" else 1)


def test_no_file_of_a_cloud_holds_the_edge_of_its_table(tmp_path, points):
    table = Plane.horizontal(0.0).ending(torch.zeros(3), torch.tensor([1.0, 0.0, 0.0]))
    with pytest.raises(BadArgument, match=r"table: expected .*got a table with an edge"):
        save_cloud(PointCloud(torch.from_numpy(points)), tmp_path / "cloud.npz", table)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_of_another_writer(tmp_path, points, encoding):
    trimesh.PointCloud(points).export(tmp_path / "a.ply", encoding=encoding)
    back = read_cloud(tmp_path / "a.ply", viewpoint=[0.0, 0.0, 1.0])
    np.testing.assert_allclose(back.points.numpy(), points, atol=1e-8)
    assert back.viewpoint.tolist() == [0, 0, 1]


def test_ply_big_endian_with_other_properties(tmp_path, points):
    header = "ply\nformat binary_big_endian 1.0\nelement vertex 60\nproperty uchar red\n"
    header += "property double x\nproperty double y\nproperty double z\nelement face 0\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    rows = b"".join(struct.pack(">Bddd", 7, *p) for p in points)
    (tmp_path / "a.ply").write_bytes(header.encode() + rows)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply").points.numpy(), points)


def test_the_surface_of_a_mesh_is_sampled(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    ball.export(tmp_path / "ball.ply")
    cloud = read_cloud(tmp_path / "ball.ply")
    radius = torch.linalg.vector_norm(cloud.points, dim=-1)
    assert radius.min() > 0.0495
    assert radius.max() <= 0.05 + 1e-7
    assert ((cloud.normals * cloud.points).sum(-1) / radius > 0.99).all()
    torch.testing.assert_close(
        read_cloud(tmp_path / "ball.ply").points, cloud.points, rtol=0, atol=0
    )
    ball.faces = ball.faces[:-5]
    ball.export(tmp_path / "open.ply")
    assert read_cloud(tmp_path / "open.ply").normals is None


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
@pytest.mark.parametrize(
    ("view", "found"), [("0.1 0.2 0.9 1 0 0 0", [0.1, 0.2, 0.9]), ("0 0 0 1 0 0 0", None)]
)
def test_pcd(tmp_path, points, encoding, view, found):
    normals = unit_rows(60)
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ normal_x normal_y normal_z\nSIZE 8 8 8 1 4 4 4\n"
    )
    header += "TYPE F F F U F F F\nCOUNT 1 1 1 4 1 1 1\nWIDTH 60\nHEIGHT 1\n"
    header += f"VIEWPOINT {view}\nPOINTS 60\nDATA {encoding}\n"
    if encoding == "ascii":
        body = "".join(
            " ".join(map(repr, [*map(float, p), 0, 0, 0, 0, *map(float, n)])) + "\n"
            for p, n in zip(points, normals, strict=True)
        ).encode()
    else:
        body = b"".join(
            struct.pack("<ddd4Bfff", *p, 0, 0, 0, 0, *n)
            for p, n in zip(points, normals, strict=True)
        )
    (tmp_path / "a.pcd").write_bytes(header.encode() + body)
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points.numpy(), points)
    np.testing.assert_allclose(cloud.normals.numpy(), normals, atol=1e-7)
    assert (None if cloud.viewpoint is None else cloud.viewpoint.tolist()) == found


def cap(turn, centre):
    """Half a ball of 40 mm, seen along z by even pixels, turned about x by degrees and moved."""
    v = np.random.default_rng(1).uniform(-1, 1, (600, 2))
    v = v[np.linalg.norm(v, axis=1) < 0.98]
    v = np.column_stack([v, -np.sqrt(1 - (v**2).sum(1))])
    c = np.cos(np.radians(turn))
    s = np.sin(np.radians(turn))
    return 0.04 * v @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) + centre


def pcd(points, view="0 0 0 1 0 0 0", data="ascii"):
    header = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {view}\nDATA {data}\n"
    return header.encode() + b"".join(b"%r %r %r\n" % tuple(map(float, p)) for p in points)


@pytest.mark.parametrize(
    ("points", "believed"),
    [
        (cap(0, [0.02, 0.05, 0.5]), True),  # a camera's own frame
        (cap(0, [0.0, 0.0, 0.02]), False),  # the origin lies in the cloud
        (cap(120, [0.5, 0.0, 0.04]), False),  # a robot's frame, seen from above
        (cap(90, [0.0, 0.0, 0.5]), False),  # seen from its side
    ],
)
def test_the_default_viewpoint_of_pcd_counts_only_where_a_camera_can_have_been_there(
    tmp_path, points, believed
):
    (tmp_path / "a.pcd").write_bytes(pcd(points))
    file = read_cloud_file(tmp_path / "a.pcd")
    assert (file.cloud.viewpoint is not None) == believed
    assert believed != any("default viewpoint" in note for note in file.notes)
    assert read_cloud(tmp_path / "a.pcd", viewpoint=[0.0, 0.0, 0.0]).viewpoint.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("place", "count"), [((30.0, 40.0), 10**6), ((200.0, 35.0), 600), ((110.0, 70.0), 10**6)]
)
def test_points_in_the_frame_of_a_camera_whose_pose_is_the_viewpoint_are_told(
    tmp_path, place, count
):
    body = trimesh.creation.icosphere(2, 0.025).apply_translation([0.5, 0.0, 0.8])
    pose = look_at(*place, 0.6, body)
    # every pixel, or some
    seen = partial_view(body, pose, count, noise=False).points
    own = apply(inverse(pose), seen)
    turned = pose[:3, :3].numpy()
    forward = turned @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x forward, z up
    for points, axes, told in (
        (own, turned, True),
        (own, np.eye(3), count > 600),
        (seen, turned, False),
        (seen, forward, False),
    ):
        x, y, z, w = Rotation.from_matrix(axes).as_quat()
        view = " ".join(f"{number:.9f}" for number in [*pose[:3, 3].tolist(), w, x, y, z])
        (tmp_path / "a.pcd").write_bytes(pcd(points.numpy(), view))
        file = read_cloud_file(tmp_path / "a.pcd")
        assert bool(file.doubts) == told and file.doubts == file.notes
        said = pytest.warns(CloudWarning, match="VIEWPOINT is elsewhere.*--camera-pose")
        with said if told else contextlib.nullcontext():
            assert file.tell("a.pcd") is file.cloud


def test_an_estimated_surface_and_a_header_with_a_scale_are_told(tmp_path):
    ball = trimesh.creation.icosphere(2, 0.05)
    ball.export(tmp_path / "a.ply")
    assert not read_cloud_file(tmp_path / "a.ply").notes
    ball.vertex_attributes["std_m"] = np.full(len(ball.vertices), 0.002, dtype=np.float32)
    ball.export(tmp_path / "a.ply")
    with pytest.warns(CloudWarning, match="an estimated surface, whose std_m are not read"):
        read_cloud(tmp_path / "a.ply")
    text = b"ply\nformat ascii 1.0\ncomment scale 0.5\nelement vertex 60\n"
    text += b"".join(b"property float %c\n" % letter for letter in b"xyz") + b"end_header\n"
    (tmp_path / "a.ply").write_bytes(
        text + b"".join(b"%f %f %f\n" % tuple(p) for p in unit_rows(60))
    )
    with pytest.warns(CloudWarning, match="'comment scale 0.5' is not applied"):
        read_cloud(tmp_path / "a.ply")


def test_the_base_of_a_robot_below_all_points_is_no_camera(tmp_path):
    body = trimesh.creation.icosphere(3, 0.05).apply_translation([0.5, 0.0, 0.05])
    seen = partial_view(body, look_at(180.0, 10.0, 0.5, body), 600, noise=False).points.numpy()
    for height, believed in ((0.0, False), (-0.1, True)):  # of the table over the base
        (tmp_path / "a.pcd").write_bytes(pcd(seen + np.array([0.0, 0.0, height])))
        file = read_cloud_file(tmp_path / "a.pcd")
        assert (file.cloud.viewpoint is not None) == believed
        assert believed != any("default viewpoint" in note for note in file.notes)


@pytest.mark.parametrize("place", [[0.7, 0.5, 0.7], [-1.0, -1.0, -1.0], [0.5, 0.0, -0.3]])
@pytest.mark.parametrize("missing", [20, 300, 4000])
def test_missing_pixels_are_left_out_wherever_they_are(tmp_path, place, missing):
    seen = cap(120, [0.5, 0.0, 0.04])
    rows = np.vstack([seen, np.tile(place, (missing, 1))])
    np.save(tmp_path / "a.npy", rows[np.random.default_rng(0).permutation(len(rows))])
    file = read_cloud_file(tmp_path / "a.npy")
    if missing == 20:  # as few may be copies of a point
        assert len(file.cloud) == len(rows) and not file.notes
        return
    assert sorted(file.cloud.points.tolist()) == sorted(seen.tolist())
    (note,) = file.notes
    assert note.startswith(f"{missing} of {len(rows)} rows at exactly (") and "missing" in note


def test_copies_of_points_are_no_missing_pixels(tmp_path):
    seen = cap(0, [0.0, 0.0, 0.5])
    for rows in (np.repeat(seen, 50, 0), np.tile(seen, (50, 1)), np.round(seen, 2)):
        np.save(tmp_path / "a.npy", rows)
        file = read_cloud_file(tmp_path / "a.npy")
        assert len(file.cloud) == len(rows) and not file.notes


def test_the_numbers_of_columns_are_no_point(tmp_path, points):
    for width, table in ((3, points), (6, np.hstack([points, unit_rows(60)]))):
        text = "\n".join(",".join(map(repr, map(float, row))) for row in table)
        path = tmp_path / "a.csv"
        path.write_text(",".join(map(str, range(width))) + "\n" + text)
        assert np.array_equal(read_cloud_file(path).cloud.points.numpy(), points)
    path.write_text("0 1 2\n3 4 7\n9 9 1\n5 6 8\n")  # whole numbers are points
    assert len(read_cloud_file(path).cloud) == 4


def compress(data):
    """Pack bytes as LZF, greedily: copies of three bytes and more, literals between."""
    out = bytearray()
    literal = bytearray()
    seen = {}
    i = 0

    def flush():
        for k in range(0, len(literal), 32):
            out.append(len(literal[k : k + 32]) - 1)
            out.extend(literal[k : k + 32])
        literal.clear()

    while i < len(data):
        key = data[i : i + 3]
        length = 0
        at = seen.get(key, -1)
        if len(key) == 3 and 0 <= at and i - at <= 8192:
            length = 3
            while i + length < len(data) and length < 264 and data[at + length] == data[i + length]:
                length += 1
        seen[key] = i
        if length:
            flush()
            away = i - at - 1
            head = [min(length - 2, 7) << 5 | away >> 8] + [length - 9] * (length >= 9)
            out.extend([*head, away & 255])
            i += length
        else:
            literal.append(data[i])
            i += 1
    flush()
    return bytes(out)


def compressed_pcd(points):
    """Pack points and a constant colour, one field after the other."""
    header = f"FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nWIDTH {len(points)}\nHEIGHT 1\nDATA binary_compressed\n"
    body = points.T.astype("<f4").tobytes() + np.full(len(points), 7, dtype="<u4").tobytes()
    packed = compress(body)
    return header.encode(), struct.pack("<II", len(packed), len(body)) + packed


def test_compressed_pcd_is_read(tmp_path, points):
    data = np.random.default_rng(3).integers(0, 3, 5000).astype(np.uint8).tobytes() + b"ab" * 500
    assert decompress(compress(data), len(data)) == data
    (tmp_path / "a.pcd").write_bytes(b"".join(compressed_pcd(points)))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.pcd").points.numpy(), points, atol=1e-8)


@pytest.mark.parametrize(
    "body",
    [
        struct.pack("<II", 5, 2**31),  # promises gigabytes
        struct.pack("<II", 2**31, 960),
        struct.pack("<II", 2, 960) + b"\x1fa",  # a literal run that ends early
        struct.pack("<II", 2, 960) + b"\x20\x00",  # a copy from before the start
        struct.pack("<II", 1, 960) + b"\xe0",
        struct.pack("<II", 4, 960) + b"\x00a\x20\x00",  # too little
        struct.pack("<II", 1004, 960) + b"\x00a" + b"\xe0\xff\x00" * 334,  # too much
        b"\x00" * 7,
    ],
)
def test_malformed_compressed_data_are_refused_by_name(tmp_path, points, body):
    (tmp_path / "a.pcd").write_bytes(compressed_pcd(points)[0] + body)
    with pytest.raises(CloudFileError, match=r"path: expected .*got .*a\.pcd"):
        read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    "line", ["comment units millimetres", "comment scale 0.1", "obj_info offset: 432100 5412300 0"]
)
def test_a_unit_or_a_scale_in_a_header_is_told(tmp_path, points, line):
    save_cloud(PointCloud(torch.from_numpy(points)), tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"ply\n", f"ply\n{line}\n".encode(), 1))
    file = read_cloud_file(tmp_path / "a.ply")
    (note,) = file.notes
    assert line in note and "--unit" in note
    torch.testing.assert_close(
        file.cloud.points, torch.from_numpy(points).double(), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize("colour", [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0.58, 0.58, 0.58)])
def test_colours_of_length_1_are_no_normals(tmp_path, colour):
    """The surface tells them from normals, which are across it, of either sign and with noise."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(900, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ball = 0.04 * normals + rng.normal(0, 0.001, (900, 3))
    np.save(tmp_path / "colours.npy", np.hstack([ball, np.broadcast_to(colour, (900, 3))]))
    found = read_cloud_file(tmp_path / "colours.npy")
    assert found.cloud.normals is None and "colours?" in found.notes[0]
    signs = rng.choice([-1.0, 1.0], (900, 1))
    np.save(tmp_path / "normals.npy", np.hstack([ball, signs * normals]))
    found = read_cloud_file(tmp_path / "normals.npy")
    assert found.cloud.normals is not None and not found.notes


@pytest.mark.parametrize("face", [600, 880])
def test_one_colour_is_told_from_normals_though_most_points_lie_on_its_face(tmp_path, face):
    """Two faces of a box, and the one alone, whose normals are right."""
    rng = np.random.default_rng(0)
    box = rng.uniform(0, 0.06, (1000, 3)) + rng.normal(0, 0.0005, (1000, 3))
    box[:face, 0] = 0.06
    box[face:, 2] = 0.06
    red = np.broadcast_to((1.0, 0, 0), (1000, 3))
    np.save(tmp_path / "red.npy", np.hstack([box, red]))
    np.save(tmp_path / "face.npy", np.hstack([box, red])[:face])
    assert read_cloud_file(tmp_path / "red.npy").cloud.normals is None
    assert read_cloud_file(tmp_path / "face.npy").cloud.normals is not None


def colours(n):
    return np.random.default_rng(2).uniform(0, 1, (n, 3))


LEFT_OUT = {
    "NaN": (
        lambda p: np.concatenate([p, [[np.nan, 0, 0], [0, np.inf, 0]]]),
        60,
        False,
        "2 of 62 rows with NaN",
    ),
    "organised": (
        lambda p: np.where(np.arange(180).reshape(6, 10, 3) < 30, np.nan, p.reshape(6, 10, 3)),
        50,
        False,
        "10 of 60 rows",
    ),
    "zeros": (
        lambda p: np.concatenate([p, np.zeros((5, 3))]),
        60,
        False,
        "5 of 65 rows at exactly",
    ),
    "colours": (
        lambda p: np.concatenate([p, colours(60)], 1),
        60,
        False,
        "columns 4 to 6 are no unit vectors",
    ),
    "colours of 8 bit": (
        lambda p: np.concatenate([p, np.round(255 * colours(60))], 1),
        60,
        False,
        "colours",
    ),
    "normals": (lambda p: np.concatenate([p, unit_rows(60)], 1), 60, True, ""),
    "organised normals": (
        lambda p: np.concatenate([p, unit_rows(60)], 1).reshape(6, 10, 6),
        60,
        True,
        "",
    ),
    "some normals NaN": (
        lambda p: np.concatenate(
            [p, np.where(np.arange(60)[:, None] < 9, np.nan, unit_rows(60))], 1
        ),
        51,
        True,
        "9 of 60 rows without a normal",
    ),
    "zero normals": (lambda p: np.concatenate([p, 0 * p], 1), 60, False, "columns 4 to 6"),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_missing_rows_and_colours_are_left_out_and_noted(tmp_path, points, name):
    make, count, normals, words = LEFT_OUT[name]
    np.save(tmp_path / "a.npy", make(points))
    file = read_cloud_file(tmp_path / "a.npy")
    assert len(file.cloud) == count and (file.cloud.normals is not None) == normals
    assert words in " ".join(file.notes) and len(file.notes) == (words != "")
    assert torch.equal(cloud_from_array(make(points)).points, file.cloud.points)


def test_units_scale_points_and_the_viewpoint_of_the_file_alone(tmp_path, points):
    np.savez(tmp_path / "a.npz", points=1000 * points, viewpoint=np.array([0.0, 0.0, 500.0]))
    cloud = read_cloud(tmp_path / "a.npz", unit="mm")
    np.testing.assert_allclose(cloud.points.numpy(), points, atol=1e-12)
    assert cloud.viewpoint.tolist() == [0, 0, 0.5]
    assert read_cloud(tmp_path / "a.npz", [0.0, 0.0, 0.4], "mm").viewpoint.tolist() == [0, 0, 0.4]


def test_a_text_of_empty_lines_or_of_many_columns_is_refused_without_reading_it_all(monkeypatch):
    monkeypatch.setattr("torchgrasp.files.columns.CLOUD_POINTS", 500)
    with pytest.raises(ValueError, match="more than 1000 lines"):
        read_lines(b"\n" * 1001 + b"1 2 3\n")
    with pytest.raises(ValueError, match="more than 16 numbers in a line"):
        read_lines(b"x y z\n" + b"1 " * 17 + b"\nx\n")
    assert read_lines(b"\n" * 999 + b"1 2 3\n").tolist() == [[1.0, 2.0, 3.0]]


def test_arrays_and_text(tmp_path, points):
    table = np.concatenate([points, unit_rows(60)], axis=1)
    np.save(tmp_path / "a.npy", points.astype(np.float32))
    np.save(tmp_path / "b.npy", np.asfortranarray(table))
    np.savetxt(tmp_path / "c.xyz", points, header="x y z")
    np.savetxt(tmp_path / "d.xyz", table, delimiter=",")
    np.savetxt(tmp_path / "e.xyz", points, newline="\r\n")
    np.savetxt(tmp_path / "f.xyz", points, newline="\r")
    (tmp_path / "g.csv").write_text(
        '"x","y","z"\n' + "".join(f"{x};{y};{z}\n" for x, y, z in points)
    )
    np.savetxt(tmp_path / "h.txt", points)
    kinds = [("g.csv", False), ("h.txt", False)]
    kinds += [
        ("a.npy", False),
        ("b.npy", True),
        ("c.xyz", False),
        ("d.xyz", True),
        ("e.xyz", False),
        ("f.xyz", False),
    ]
    for name, normals in kinds:
        cloud = read_cloud(tmp_path / name)
        np.testing.assert_allclose(cloud.points.numpy(), points, atol=1e-8)
        assert (cloud.normals is not None) == normals


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".npy", ".xyz"])
@pytest.mark.parametrize(
    "content",
    [b"", b"\x00\xff\xfe" * 50, b"ply\n", b"DATA ascii\n", b"PK\x03\x04", b"\x93NUMPY\x01\x00"],
)
def test_malformed_content_is_refused_by_name(tmp_path, suffix, content):
    (tmp_path / f"a{suffix}").write_bytes(content)
    with pytest.raises((CloudFileError, TooFewPoints), match=r"path: expected .*got"):
        read_cloud(tmp_path / f"a{suffix}")


def test_for_a_depth_image_the_command_is_named_that_takes_one(tmp_path):
    np.save(tmp_path / "depth.npy", np.ones((480, 640)))
    for name in ("depth.png", "depth.npy"):
        with pytest.raises(CloudFileError, match="`torchgrasp cloud scene` makes a scene"):
            read_cloud(tmp_path / name)
    with pytest.raises(CloudFileError, match=r"expected a file ending in .ply[^`]*$"):
        read_cloud(tmp_path / "scan.docx")


@pytest.mark.parametrize("suffix", [".ply", ".npz", ".npy", ".pcd", ".xyz", "_packed.pcd"])
def test_spoilt_or_truncated_bytes_are_refused_by_name_or_read(tmp_path, points, suffix):
    path = tmp_path / f"a{suffix}"
    if suffix in (".ply", ".npz"):
        save_cloud(PointCloud(torch.from_numpy(points)), path)
    elif suffix == ".npy":
        np.save(path, points)
    elif suffix == "_packed.pcd":
        path.write_bytes(b"".join(compressed_pcd(points)))
    else:
        header = "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 60\nHEIGHT 1\nDATA ascii"
        np.savetxt(path, points, header=header if suffix == ".pcd" else "", comments="")
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(60):
        spoilt = bytearray(data)
        for place in rng.integers(0, min(len(data), 300), 3):
            spoilt[place] = rng.integers(0, 256)
        path.write_bytes(spoilt)
        with contextlib.suppress(GraspError):
            assert torch.isfinite(read_cloud(path).points).all()
    for stop in range(0, len(data) - 1, 37):
        path.write_bytes(data[:stop])
        with (
            pytest.raises(GraspError)
            if suffix in (".ply", ".npz", ".npy")
            else contextlib.suppress(GraspError)
        ):
            read_cloud(path)


def test_headers_that_promise_too_much_are_refused_before_memory_is_taken(tmp_path):
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 99999999999999\nproperty float x\n"
    )
    (tmp_path / "a.ply").write_text(header + "property float y\nproperty float z\nend_header\n")
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": "<f8", "fortran_order": False, "shape": (10**13, 3)}
    )
    (tmp_path / "b.npy").write_bytes(buffer.getvalue())
    with zipfile.ZipFile(tmp_path / "c.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", buffer.getvalue() + bytes(1000))
    (tmp_path / "d.pcd").write_text(
        "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 99999999999999\nDATA binary\n"
    )
    (tmp_path / "e.ply").write_text(
        header.replace("binary_little_endian", "ascii")
        + "property float y\nproperty float z\nend_header\n1 2 3\n"
    )
    for name in ("a.ply", "b.npy", "c.npz", "d.pcd", "e.ply"):
        with pytest.raises(CloudFileError):
            read_cloud(tmp_path / name)


def test_columns_whose_squares_overflow_are_no_normals(tmp_path, points):
    table = np.concatenate([points, unit_rows(60)], 1)
    table[0, 3] = 1e200
    np.save(tmp_path / "table.npy", table)
    assert (
        read_cloud_file(tmp_path / "table.npy").cloud.normals is not None
    )  # one of many: the others are normals
    table[:, 3] = 1e200
    np.save(tmp_path / "table.npy", table)
    assert read_cloud_file(tmp_path / "table.npy").cloud.normals is None


MESH = [
    "ply",
    "format binary_little_endian 1.0",
    "element vertex 3",
    *(f"property float {x}" for x in "xyz"),
]
FACES = [*MESH, "element face 500001", "property list uchar int vertex_indices", "end_header\n"]
PROPERTIES = [
    *MESH,
    "element face 1",
    *(f"property list uchar int p{k}" for k in range(254)),
    "end_header\n",
]
OBJECTS = np.array([{"code": 1}], dtype=object)
REFUSED = {
    "millimetres": (lambda p: 1000 * p, SuspiciousScale, "mm"),
    "normalised": (lambda p: 1e-3 * p, SuspiciousScale, "normalised"),
    "missing": (
        lambda p: np.where(np.arange(180).reshape(60, 3) < 170, np.nan, p),
        TooFewPoints,
        "57 of 60 rows with",
    ),
    "three points": (lambda p: p[:3], TooFewPoints, "3 points"),
    "two columns": (lambda p: p[:, :2], CloudFileError, "shape"),
    "complex": (lambda p: p + 1j, CloudFileError, "real numbers"),
    "pickled": (lambda p: OBJECTS, CloudFileError, "objects|object|pickle"),
    "pickled in .npz": (lambda p: {"points": OBJECTS}, CloudFileError, "object|pickle"),
    "other names": (
        lambda p: {"xyz": p, "rgb": p},
        CloudFileError,
        r"no array named 'points', but \['xyz', 'rgb'\]",
    ),
    "NaN viewpoint": (
        lambda p: {"points": p, "viewpoint": np.array([0, np.nan, 1])},
        BadArgument,
        "viewpoint with NaN",
    ),
    "frustum": (
        lambda p: {"points": p, "frustum": np.ones((3, 3))},
        CloudFileError,
        r"a frustum of shape \(3, 3\)",
    ),
    "many faces": (
        lambda p: "\n".join(FACES).encode(),
        CloudFileError,
        "500001 faces",
    ),  # before the body is read
    "many properties": (
        lambda p: "\n".join(PROPERTIES).encode() + bytes(10_000),
        CloudFileError,
        "257 properties",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_read_cloud_names_what_is_wrong(tmp_path, points, name):
    make, error, words = REFUSED[name]
    content = make(points)
    path = tmp_path / (
        "a.npz" if isinstance(content, dict) else "a.ply" if isinstance(content, bytes) else "a.npy"
    )
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    else:
        np.save(path, content)
    with pytest.raises(error, match=words):
        read_cloud(path)


def test_wrong_paths_and_viewpoints_are_refused_by_name(tmp_path, points):
    np.save(tmp_path / "a.npy", points)
    for name, words in (("missing.ply", "no file"), ("scan.docx", r"\.ply, \.pcd")):
        with pytest.raises(CloudFileError, match=words):
            read_cloud(tmp_path / name)
    for viewpoint in ([0.0, 1.0], ["x", 0.0, 1.0]):
        with pytest.raises(
            (BadArgument, TypeError), match="viewpoint"
        ):  # TypeError: annotations are checked in tests
            read_cloud(tmp_path / "a.npy", viewpoint=viewpoint)  # pyright: ignore[reportArgumentType]
    with pytest.raises(OutputError):
        save_cloud(PointCloud(torch.from_numpy(points)), tmp_path / "a.npy" / "b.npz")


def test_masked_numbers_are_refused_as_they_would_count():
    """NumPy forgets a mask where an array is converted."""
    points = np.random.default_rng(0).random((50, 3))
    some = np.ma.masked_greater(points, 0.9)
    with pytest.raises(BadArgument, match=r"masked array, with .* of 150 numbers masked"):
        cloud_from_array(some)
    # as the error says
    assert len(cloud_from_array(some.filled(np.nan))) < 50
    assert len(cloud_from_array(np.ma.array(points))) == 50
    depth = np.full((8, 8), 0.5)
    with pytest.raises(BadArgument, match=r"depth: .*masked"):
        cloud_from_depth(np.ma.array(depth, mask=depth > 0), (60.0, 60.0, 4.0, 4.0))
