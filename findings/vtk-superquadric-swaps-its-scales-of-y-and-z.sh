#!/usr/bin/env bash
# VTK and PyVista: a superquadric with scale=(30, 20, 10) has half axes of 30, 10 and 20. Those of y and z are swapped.
# PyVista's help calls them "Scale factors of the superquadric in [x, y, z]". VTK's own function, vtkSuperquadric, does use x,
# y, z with the same settings. By it, points of the mesh are far inside or far outside. The centre is right. So an object that
# was fitted for grasps becomes another one. No warning. The scales are applied before the axis of symmetry is turned from z
# to y. So they are swapped about x, too, and right about z: SuperquadricSource.SetAxisOfSymmetry(2).
# Packages: pyvista 0.49.1, vtk 9.7.2, numpy 2.4.6; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check pyvista==0.49.1 vtk==9.7.2 numpy==2.4.6
cat > "$place/try.py" << 'END'
import numpy as np
import pyvista
from vtkmodules.vtkCommonCore import vtkVersion
from vtkmodules.vtkCommonDataModel import vtkSuperquadric

SCALE = (30.0, 20.0, 10.0)  # [mm]
CENTRE = (1.0, 2.0, 3.0)
ROUND = {"theta_roundness": 0.4, "phi_roundness": 0.8}
AXES = "xyz"


def function(points):
    """Return VTK's own function at points: 0 on the superquadric, negative inside."""
    solid = vtkSuperquadric()
    solid.SetScale(SCALE)
    solid.SetCenter(CENTRE)
    solid.SetSize(1)
    solid.SetThetaRoundness(ROUND["theta_roundness"])
    solid.SetPhiRoundness(ROUND["phi_roundness"])
    return np.array([solid.EvaluateFunction(point) for point in points])


def equation(points, half_axes, along):
    """Return Barr's equation of a superquadric about an axis, less 1."""
    sides = [axis for axis in range(3) if axis != along]
    parts = np.abs((points - CENTRE) / half_axes)
    east, north = ROUND["theta_roundness"], ROUND["phi_roundness"]
    around = (parts[:, sides] ** (2 / east)).sum(axis=1)
    return around ** (east / north) + parts[:, along] ** (2 / north) - 1


print("pyvista", pyvista.__version__, "vtk", vtkVersion.GetVTKVersion())
assert "Scale factors of the superquadric in ``[x, y, z]``" in pyvista.Superquadric.__doc__
mesh = pyvista.Superquadric(
    center=CENTRE, scale=SCALE, size=1, theta_resolution=64, phi_resolution=64, **ROUND
)
half = np.subtract(mesh.bounds[1::2], mesh.bounds[::2]) / 2
values = function(mesh.points)
print(f"half axes of the mesh {half.round(2)}, asked for {SCALE}")
print(f"VTK's function on the mesh, where 0 is right: {values.min():.2f} to {values.max():.2f}")
assert np.allclose(half, (30, 10, 20), rtol=0.01) and np.allclose(mesh.center, CENTRE, atol=0.1)
assert values.min() < -0.5 and values.max() > 2
points = mesh.points.astype(float)
assert np.abs(equation(points, (30, 10, 20), along=1)).max() < 0.01
scaled = (points - CENTRE) * (1, 20 / 10, 10 / 20) + CENTRE
assert np.abs(function(scaled)).max() < 0.01  # but for the scales, the two agree

# VTK's function lies on the axes where the scale says
ends = np.array(CENTRE) + np.diag(SCALE)
assert np.abs(function(ends)).max() < 1e-9

expected = {0: (10, 20, 30), 1: (30, 10, 20), 2: SCALE}
for along, true in expected.items():
    source = pyvista.SuperquadricSource(scale=SCALE, size=1, theta_resolution=64, phi_resolution=64, **ROUND)
    source.SetAxisOfSymmetry(along)
    bounds = source.output.bounds
    half = np.subtract(bounds[1::2], bounds[::2]) / 2
    print(f"axis of symmetry {AXES[along]}: half axes {half.round(2)}")
    assert np.allclose(half, true, rtol=0.01)
    shape = source.output.points + np.array(CENTRE)
    assert np.abs(equation(shape, true, along)).max() < 0.01

ball = pyvista.ParametricSuperEllipsoid(*SCALE)
assert np.allclose(np.subtract(ball.bounds[1::2], ball.bounds[::2]) / 2, SCALE, rtol=0.01)  # this one keeps its radii
END
"$place/bin/python" "$place/try.py"
