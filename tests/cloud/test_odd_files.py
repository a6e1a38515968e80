"""Odd but plausible files of clouds: each is read for what it is, or refused in a sentence of ours."""

import struct

import numpy as np
import pytest

from torchgrasp.cloud.read import read_cloud_file
from torchgrasp.foundation.errors import CloudFileError

POINTS = np.random.default_rng(0).uniform(0.01, 0.09, (60, 3)).round(4)
NORMALS = np.random.default_rng(1).normal(size=(60, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
COLOURS = np.random.default_rng(2).integers(1, 255, (60, 3))
BOTH = np.hstack([POINTS, NORMALS])
COLOURED = np.hstack([POINTS, COLOURS])
XYZ = ("float x", "float y", "float z")


def rows(table, between=" "):
    return "".join(between.join(f"{x:.4f}" for x in row) + "\n" for row in table)


def ply(properties, body, encoding="ascii"):
    lines = [
        "ply",
        f"format {encoding} 1.0",
        "element vertex 60",
        *(f"property {p}" for p in properties),
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode() + (body if isinstance(body, bytes) else body.encode())


def pcd(names, body, data="ascii"):
    count = len(names.split())
    header = f"FIELDS {names}\nSIZE {'4 ' * count}\nTYPE {'F ' * count}\nWIDTH 60\nHEIGHT 1\nDATA {data}\n"
    return header.encode() + (body if isinstance(body, bytes) else body.encode())


def listed(lengths):
    """Rows of a point and a list of whole numbers, of the given lengths."""
    return "".join(
        " ".join([*(f"{x:.4f}" for x in p), str(n), *["7"] * n]) + "\n"
        for p, n in zip(POINTS, lengths, strict=True)
    )


FLAGS = [*XYZ, "list uchar int flags"]
PACKED = b"".join(struct.pack("<fffBii", *p, 2, 4, 5) for p in POINTS)
READ = {
    "upper.ply": (
        ply(["float X", "float Y", "float Z", "float NX", "float NY", "float NZ"], rows(BOTH)),
        True,
        "",
    ),
    "named.ply": (ply([*XYZ, *(f"float normal_{x}" for x in "xyz")], rows(BOTH)), True, ""),
    "list.ply": (ply(FLAGS, listed([2] * 60)), False, "list flags"),
    "packed.ply": (ply(FLAGS, PACKED, "binary_little_endian"), False, "list flags"),
    "first.ply": (
        ply(
            ["list uchar int flags", *XYZ],
            "".join(f"1 7 {r}\n" for r in rows(POINTS).split("\n")[:60]),
        ),
        False,
        "flags",
    ),
    "mac.ply": (ply(XYZ, rows(POINTS)).replace(b"\n", b"\r"), False, ""),
    "upper.pcd": (pcd("X Y Z", rows(POINTS)), False, ""),
    "short.pcd": (pcd("x y z nx ny nz", rows(BOTH)), True, ""),
    "counted.pts": (
        "60\n" + rows(np.hstack([POINTS, COLOURS[:, :1], COLOURS])),
        False,
        "intensity, red, green, blue",
    ),
    "plain.pts": (rows(POINTS), False, ""),
    "a.xyzi": (rows(COLOURED[:, :4]), False, "intensity"),
    "a.xyzn": (rows(BOTH), True, ""),
    "a.xyzrgb": (rows(COLOURED), False, "red, green, blue"),
    "counted.asc": ("//X Y Z R G B\n60\n" + rows(COLOURED), False, "R, G, B"),
    "a.asc": ("//X Y Z R G B\n" + rows(COLOURED), False, "R, G, B"),
    "normals.csv": (
        "X;Y;Z;Nx;Ny;Nz;curvature\n" + rows(BOTH[:, [0, 1, 2, 3, 4, 5, 0]], ";"),
        True,
        "curvature",
    ),
    "turned.csv": ("t,z,y,x\n" + rows(COLOURED[:, [3, 2, 1, 0]], ","), False, "columns t were"),
    "comment.txt": ("# z y x\n" + rows(POINTS[:, ::-1]), False, ""),
    "sentence.txt": ("# x y z in mm\n" + rows(POINTS), False, ""),
    "columns.txt": ("# columns: z y x r\n" + rows(COLOURED[:, [2, 1, 0, 3]]), False, "columns r"),
    "excel.csv": ("\ufeffx,y,z\n" + rows(POINTS, ","), False, ""),
    "quoted.csv": (
        "".join('"' + '","'.join(f"{x:.4f}" for x in p) + '"\n' for p in POINTS),
        False,
        "",
    ),
    "named.npy": (np.rec.fromarrays(POINTS.T, names="x,y,z"), False, ""),
    "organised.npy": (
        np.rec.fromarrays(COLOURED.T[:4].reshape(4, 6, 10), names="x,y,z,rgb"),
        False,
        "rgb",
    ),
}
TOLD = {
    "semicolons.csv": (
        rows(POINTS, ";").replace(".", ","),
        "decimal commas",
    ),  # was read, as six columns
    "tabs.txt": (rows(POINTS, "\t").replace(".", ","), "decimal commas"),
    "commas.csv": (rows(POINTS, ",").replace(".", ","), "decimal commas"),
    "quotes.csv": (
        "".join(f'"{r}"\n' for r in rows(POINTS, '","').replace(".", ",").split("\n")[:60]),
        "decimal",
    ),
    "cells.csv": ("".join(f"{x:f},,{z:f},5\n" for x, _, z in POINTS), "an empty cell"),
    "wide.ply": (
        ply(XYZ, rows(COLOURED)),
        "6 numbers in the first row, where the header promises 3",
    ),
    "wide.pcd": (pcd("x y z", rows(COLOURED)), "6 numbers in the first row"),
    "long.pcd": (pcd("x y z", rows(POINTS) + "0.1 0.2 0.3\n"), "183 numbers, more than"),
    "short.ply": (ply(XYZ, rows(POINTS[:59])), "177 numbers, fewer than the promised 60 points"),
    "double.ply": (
        ply(XYZ, POINTS.tobytes(), "binary_little_endian"),
        "1440 bytes of points, .* promises 720",
    ),
    "double.pcd": (pcd("x y z", POINTS.tobytes(), "binary"), "1440 bytes"),
    "cut.ply": (ply(XYZ, bytes(620), "binary_little_endian"), "620 bytes"),
    "cut.pcd": (pcd("x y z", bytes(620), "binary"), "620 bytes"),
    # as many words as columns: x was read from the second column
    "sentence.txt": ("# points x y z in mm\n" + rows(BOTH), "names alone, one for each column"),
    "flat.ply": (ply(XYZ[:2], rows(POINTS[:, :2])), "columns 'x y' without z"),
    "half.ply": (ply([*XYZ, "float nx", "float ny"], rows(BOTH[:, :5])), "without nz"),
    "twice.ply": (ply([*XYZ, "float X"], rows(COLOURED[:, :4])), "two columns X"),
    "uneven.ply": (
        ply(FLAGS, listed([k % 3 for k in range(60)])),
        "a list flags of different lengths|numbers",
    ),
    "other.pcd": (pcd("a b c", rows(POINTS)), "without x, y, z"),
    "bare.pcd": (b"SIZE 4\nTYPE F\nWIDTH 60\nHEIGHT 1\nDATA ascii\n1", "a header without FIELDS"),
    "words.pcd": (
        pcd("x y z", rows(POINTS)).replace(b"WIDTH 60", b"WIDTH sixty"),
        "broken or cut off",
    ),
    "counted.pts": ("70\n" + rows(POINTS), "60 rows, where the first line promises 70"),
    "four.xyz": (rows(COLOURED[:, :4]), "4 columns with no line of names above, such as x y z"),
    "other.csv": (
        "easting,northing,height\n" + rows(POINTS, ","),
        "columns 'easting northing height' without x, y, z",
    ),
    "pandas.csv": (
        ",x,y,z\n" + rows(COLOURED[:, [3, 0, 1, 2]], ","),
        "4 columns with the names 'x y z'",
    ),
    # with a column more, the first would be taken for x
    "index.csv": (
        ",0,1\n" + "".join(f"{k},{x:f},{y:f}\n" for k, (x, y, _) in enumerate(POINTS)),
        "line 2, .*, where 2 numbers",
    ),
    "null.csv": (
        "x,y,z\n" + rows(POINTS, ",") + "null,0.1,0.2\n",
        "line 62, 'null,0.1,0.2', where 3 numbers",
    ),
    "ragged.xyz": (rows(POINTS) + "0.1 0.2\n", "line 61, '0.1 0.2', where 3 numbers"),
    "fortran.xyz": (rows(POINTS).replace("\n", "D0\n"), "line 1, "),
    "molecule.xyz": (
        "60\nwater\n" + "".join(f"C {r}\n" for r in rows(POINTS).split("\n")[:60]),
        "line 2, 'water'",
    ),
    "wide.txt": (rows(POINTS).encode("utf-16"), "another encoding than UTF-8"),
    "latin.txt": (("# L\xe4nge\n" + rows(POINTS)).encode("latin-1"), "another encoding than UTF-8"),
    "pointer.ply": (
        "version https://git-lfs.github.com/spec/v1\noid sha256:abc\nsize 123\n",
        "git lfs pull",
    ),
    "text.npy": (rows(POINTS), "no header of an .npy file"),
    "text.npz": (rows(POINTS), "no archive"),
}
FOREIGN = (
    "Error(",
    "usecols",
    "codec",
    "could not convert",
    "invalid literal",
    "zip file",
    "magic",
    "Traceback",
)


def write(path, content):
    if isinstance(content, np.ndarray):
        np.save(path, content)
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", READ)
def test_what_is_unambiguous_is_read(tmp_path, name):
    content, normals, words = READ[name]
    file = read_cloud_file(write(tmp_path / name, content))
    np.testing.assert_allclose(file.cloud.points.numpy(), POINTS, atol=1e-8)
    assert words in " ".join(file.notes) and len(file.notes) == bool(words)
    assert (file.cloud.normals is not None) == normals
    if file.cloud.normals is not None:
        np.testing.assert_allclose(file.cloud.normals.numpy(), NORMALS, atol=1e-4)


@pytest.mark.parametrize("name", TOLD)
def test_what_is_wrong_is_told_in_our_words(tmp_path, name):
    content, words = TOLD[name]
    with pytest.raises(CloudFileError, match=words) as told:
        read_cloud_file(write(tmp_path / name, content))
    assert not [word for word in FOREIGN if word in str(told.value)]
