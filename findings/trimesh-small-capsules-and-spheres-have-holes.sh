#!/usr/bin/env bash
# trimesh: a capsule with a radius of 4 mm or less, built in metres, has holes at both ends; made in millimetres it is closed.
# creation.capsule, uv_sphere and revolve drop each triangle of less than 1e-8 square units. At 1 mm, both caps of a capsule are
# gone, and a uv_sphere has no triangle at all, yet is_watertight says True. The primitive Capsule is open, too; no warning.
# Packages: trimesh 5.2.0 (4.12.2 does likewise), numpy 2.4.6, scipy 1.17.1, networkx 3.6.1; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6 scipy==1.17.1 networkx==3.6.1
cat > "$place/try.py" << 'END'
import trimesh
from trimesh.creation import capsule, uv_sphere

LENGTH = 20  # from centre to centre [mm]
found = {}
print("trimesh", trimesh.__version__)
for radius in (5, 4, 3, 2, 1):  # [mm]
    metres = capsule(LENGTH / 1000, radius / 1000)
    millimetres = capsule(LENGTH, radius)
    assert millimetres.is_volume and len(millimetres.faces) == 4096
    again = millimetres.copy().apply_scale(0.001)
    assert again.is_volume and len(again.faces) == 4096  # so the small mesh is no fault in itself
    primitive = trimesh.primitives.Capsule(radius=radius / 1000, height=LENGTH / 1000)
    assert primitive.is_volume == metres.is_volume
    short = 1000 * (again.extents[2] - metres.extents[2])
    sphere = uv_sphere(radius / 1000)
    assert len(uv_sphere(radius).faces) == 3840
    found[radius] = len(metres.faces), metres.is_watertight, round(short, 2), len(sphere.faces), sphere.is_watertight
    print(
        f"radius {radius} mm: capsule of {len(metres.faces)} of 4096 faces, watertight {metres.is_watertight}, "
        f"{short:.2f} mm too short; sphere of {len(sphere.faces)} of 3840 faces, watertight {sphere.is_watertight}"
    )
assert found == {
    5: (4096, True, 0.0, 3840, True),
    4: (3840, False, 0.04, 3584, False),
    3: (3584, False, 0.12, 3328, False),
    2: (2816, False, 0.47, 2560, False),
    1: (128, False, 2.0, 0, True),
}, found
END
"$place/bin/python" "$place/try.py"
