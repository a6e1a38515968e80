#!/usr/bin/env bash
# trimesh 5.2: a concave face of an OBJ file is split into a fan from its first corner, which may lie outside of the face.
# From four of the six corners of an L, folded triangles cover the notch: a prism of 160 cm2 has 192 cm2. It stays watertight,
# a volume and of 100 cm3, and `contains` is right, but a ray down the notch, where nothing is, hits twice.
# Packages: trimesh 5.2.0, numpy 2.4.6, scipy 1.17.1, rtree 1.4.1; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6 scipy==1.17.1 rtree==1.4.1
"$place/bin/python" - << 'END'
import io

import trimesh

corners = [(0, 0), (0.06, 0), (0.06, 0.02), (0.02, 0.02), (0.02, 0.06), (0, 0.06)]
height = 0.05
n = len(corners)


def prism(first):
    """The L as an OBJ file: two caps of six corners, both from the same one, and six walls of four."""
    outline = corners[first:] + corners[:first]
    lines = [f"v {x} {y} {z}" for z in (0.0, height) for x, y in outline]
    lines.append("f " + " ".join(str(k) for k in (1, *range(n, 1, -1))))
    lines.append("f " + " ".join(str(n + k) for k in range(1, n + 1)))
    for k in range(1, n + 1):
        after = k % n + 1
        lines.append(f"f {k} {after} {n + after} {n + k}")
    return trimesh.load(io.BytesIO("\n".join(lines).encode()), file_type="obj", force="mesh")


found = []
for first in range(n):
    mesh = prism(first)
    hits = len(mesh.ray.intersects_location([[0.035, 0.03, 1.0]], [[0.0, 0.0, -1.0]])[0])
    inside = bool(mesh.contains([[0.035, 0.03, 0.025]])[0])
    row = mesh.is_watertight, mesh.is_volume, round(1e6 * mesh.volume), round(1e4 * mesh.area), hits, inside
    print("first corner", corners[first], "watertight, volume, cm3, cm2, hits in the notch, inside:", *row)
    found.append(row)
assert all(row[:3] == (True, True, 100) for row in found), found
assert [row[3:5] for row in found] == [(160, 0), (192, 2), (192, 2), (160, 0), (192, 2), (192, 2)], found
assert not any(row[5] for row in found), found
END
