#!/usr/bin/env bash
# spatialmath: Line3.distance is right only for lines at right angles whose directions have length 1.
# Two lines 20 mm apart, each through two points that are 100 mm apart, are 20 m apart. Given in millimetres, the same lines
# are 20 nm apart. With unit directions the distance is 40 mm at 30 degrees, and 115 mm at 10 degrees. Lines that meet are
# metres apart, too, and intersects finds no point. The help says "the minimum distance between two lines" and "Works for
# parallel, skew and intersecting lines". No warning. The method named under "see also", closest_to_line, is right for all.
# So whether the forces of two fingers meet, or a finger's axis clears a pencil, may be wrong by a factor of a thousand.
# Packages: spatialmath-python 1.1.18, numpy 2.4.6; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check spatialmath-python==1.1.18 numpy==2.4.6
cat > "$place/try.py" << 'END'
from importlib.metadata import version

import numpy as np
from spatialmath import Line3

GAP, REACH = 0.02, 0.1  # between the lines, and between the two points of each [m]
ABOVE = np.array([0.0, 0.0, GAP])


def pair(angle, gap, unit=1.0, normed=False):
    """Return two lines at an angle [degrees], one `gap` above the other, in metres or in a unit of 1 / `unit` metres."""
    start = np.array([0.3, 0.2, 0.1])
    turned = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    lines = []
    for point, direction in ((start, np.array([1.0, 0.0, 0.0])), (start + gap, turned)):
        if normed:
            lines.append(Line3.PointDir(unit * point, direction))
        else:
            lines.append(Line3.Join(unit * point, unit * (point + REACH * direction)))
    return lines


def by_numpy(one, other):
    across = np.cross(one.w, other.w)
    return abs(np.dot(other.pp - one.pp, across)) / np.linalg.norm(across)


print("spatialmath-python", version("spatialmath-python"))
text = " ".join(Line3.distance.__doc__.split())
assert "the minimum distance between two lines" in text and "parallel, skew and intersecting lines" in text
expected = {  # angle, gap, unit, unit directions: the distance returned in millimetres
    "unit directions, 90 degrees": ((90, ABOVE, 1.0, True), 20.0),
    "unit directions, 30 degrees": ((30, ABOVE, 1.0, True), 40.0),
    "unit directions, 10 degrees": ((10, ABOVE, 1.0, True), 20 / np.sin(np.radians(10))),
    "by two points, 90 degrees, in metres": ((90, ABOVE, 1.0, False), 20_000.0),
    "by two points, 90 degrees, in millimetres": ((90, ABOVE, 1000.0, False), 2e-5),
}
for name, (arguments, wrong) in expected.items():
    one, other = pair(*arguments)
    scale = 1000 / arguments[2]  # to millimetres
    found, nearest, true = scale * one.distance(other), scale * one.closest_to_line(other)[1], scale * by_numpy(one, other)
    print(f"{name}: distance {found:.6g} mm, closest_to_line {nearest:.6g} mm, NumPy {true:.6g} mm")
    assert np.isclose(true, 1000 * GAP) and np.isclose(nearest, true)
    assert np.isclose(found, wrong, rtol=1e-6, atol=0), (found, wrong)

one, other = Line3.Join([0.3, 0.2, 0.1], [0.4, 0.2, 0.1]), Line3.Join([0.3, 0.2, 0.1], [0.35, 0.3, 0.1])
point, nearest = one.closest_to_line(other)
print(
    f"two lines through {point.round(3)}: distance {one.distance(other):.3g} m, intersects {one.intersects(other)}, "
    f"closest_to_line {nearest:.1g} m"
)
assert np.allclose(point, [0.3, 0.2, 0.1]) and nearest < 1e-12
assert one.distance(other) > 1 and one.intersects(other) is None
END
"$place/bin/python" "$place/try.py"
