#!/usr/bin/env bash
# trimesh: a scene shrunk from millimetres to metres keeps its volume, and its moment of inertia grows a million times.
# Scene.volume, area and mass centre ignore a scale in the graph (of apply_scale, or a node of a GLB); the inertia is divided
# by its square. No warning. The extents, to_mesh(), scaled() and convert_units() are right.
# Packages: trimesh 5.2.0 (4.12.2 does the same), numpy 2.4.6, scipy 1.17.1; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
cat > "$place/try.py" << 'END'
import sys

import numpy as np
import trimesh

box = trimesh.creation.box((10, 20, 40))  # [mm]
moved = trimesh.Scene([box])
moved.apply_scale(0.001)
held = trimesh.Scene()
held.add_geometry(box, transform=np.diag([0.001, 0.001, 0.001, 1]))  # as the exporters of modelling tools write it
file = f"{sys.argv[1]}/box.glb"
held.export(file)
scenes = {
    "apply_scale": moved,
    "node of a GLB": trimesh.load_scene(file),
    "scaled": trimesh.Scene([box]).scaled(0.001),
}
print("trimesh", trimesh.__version__)
for name, scene in scenes.items():
    mesh = scene.to_mesh()
    assert np.allclose(scene.extents, [0.01, 0.02, 0.04]) and np.allclose(mesh.extents, scene.extents)
    assert np.isclose(mesh.volume, 8e-6)
    volume, area = scene.volume / mesh.volume, scene.area / mesh.area
    inertia = scene.moment_inertia[0, 0] / box.moment_inertia[0, 0]
    true = mesh.moment_inertia[0, 0] / box.moment_inertia[0, 0]
    print(f"{name:13}: volume {volume:.3g} and area {area:.3g} of the true ones; inertia times {inertia:.3g}, right is {true:.3g}")
    if name == "scaled":
        assert np.allclose([volume, area, inertia / true], 1)
    else:
        assert np.allclose([volume, area, inertia], [1e9, 1e6, 1e6])
    assert np.isclose(true, 1e-15, atol=0)

cube = trimesh.creation.box((1, 1, 1))
pair = trimesh.Scene()
pair.add_geometry(cube, transform=np.diag([2, 2, 2, 1]))
pair.add_geometry(cube, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
found, true = pair.center_mass, pair.to_mesh().center_mass
print(f"a cube of side 2 at 0 and one of side 1 at 5: mass centre at {found[0]:.3f}, right is {true[0]:.3f}")
assert np.allclose(true, [5 / 9, 0, 0]) and np.allclose(found, [2.5, 0, 0])
END
for version in 4.12.2 5.2.0; do
    "$place/bin/python" -m pip install -qq --disable-pip-version-check trimesh==$version numpy==2.4.6 scipy==1.17.1
    "$place/bin/python" "$place/try.py" "$place"
done
