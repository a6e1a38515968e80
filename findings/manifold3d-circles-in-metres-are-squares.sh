#!/usr/bin/env bash
# manifold3d: a cylinder with a radius of 30 mm is a square bar when built in metres, with 64 % of the volume; a sphere is an
# octahedron, with 32 %. An outline inflated by a clearance of 5 mm has chamfered corners, where only 3.5 mm are kept.
# By default a circle has edges of at least one unit, and at least four of them. In millimetres all volumes are right to 2 %.
# No warning. set_min_circular_edge_length, or circular_segments in each call, makes both units alike.
# Packages: manifold3d 3.5.4, numpy 2.4.6; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check manifold3d==3.5.4 numpy==2.4.6
cat > "$place/try.py" << 'END'
from importlib.metadata import version

import manifold3d
import numpy as np
from manifold3d import CrossSection, JoinType, Manifold

RADIUS, HEIGHT, CLEAR = 30, 100, 5  # [mm]


def measure(unit):
    """Return the shares of the true volumes, and the clearance [mm] at an inflated square's corner; `unit` is 1 mm."""
    r, h, clear = RADIUS * unit, HEIGHT * unit, CLEAR * unit
    shares = {
        "cylinder": Manifold.cylinder(h, r).volume() / (np.pi * r * r * h),
        "revolved": Manifold.revolve(CrossSection.square((r, h))).volume() / (np.pi * r * r * h),
        "sphere": Manifold.sphere(r).volume() / (4 / 3 * np.pi * r**3),
    }
    around = CrossSection.square((2 * r, 2 * r), center=True).offset(clear, JoinType.Round)
    (outline,) = around.to_polygons()
    reach = (outline @ [1, 1]).max() / np.sqrt(2)  # along the diagonal
    return shares, float(reach - r * np.sqrt(2)) / unit


def tell(name, unit):
    shares, kept = measure(unit)
    words = ", ".join(f"{shape} {share:.2f}" for shape, share in shares.items())
    print(f"{name}: share of the true volume: {words}; clearance at a corner {kept:.2f} mm of {CLEAR} mm")
    return shares, kept


print("manifold3d", version("manifold3d"))
shares, kept = tell("millimetres", 1)
assert min(shares.values()) > 0.98 and kept > 0.98 * CLEAR
shares, kept = tell("metres", 1e-3)
assert np.allclose([shares["cylinder"], shares["revolved"], shares["sphere"]], [2 / np.pi, 2 / np.pi, 1 / np.pi], atol=1e-4)
assert abs(kept - CLEAR / np.sqrt(2)) < 0.01
manifold3d.set_min_circular_edge_length(1e-3)
shares, kept = tell("metres, edges of at least 1 mm", 1e-3)
assert min(shares.values()) > 0.98 and kept > 0.98 * CLEAR
END
"$place/bin/python" "$place/try.py"
