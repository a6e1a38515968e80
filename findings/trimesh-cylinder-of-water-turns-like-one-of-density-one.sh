#!/usr/bin/env bash
# trimesh: the moment of inertia of a cylinder or a sphere primitive ignores the density that was set; its mass does not. A
# can of 60 x 100 mm, of water's density 1000, weighs 283 g and turns as if it weighed 0.28 g. Its principal components are as
# wrong. Boxes, capsules and the same can as a plain mesh have the right tensor. So have mass_properties of the same can, and
# moment_inertia_frame at its centre. No warning. By the help, the density is "used in inertia calculations".
# A density that is not set is 1, so many scale the tensor by mass / volume. With a density, that is right for the can alone.
# The box's tensor becomes 1000 times too large. mass_properties, scaled by its own mass, serves both.
# Packages: trimesh 5.2.0, numpy 2.4.6, scipy 1.17.1, networkx 3.6.1; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6 scipy==1.17.1 networkx==3.6.1
cat > "$place/try.py" << 'END'
import numpy as np
import trimesh

DENSITY = 1000.0  # of water [kg/m3]
bodies = {
    "cylinder": trimesh.primitives.Cylinder(radius=0.03, height=0.1, sections=256),
    "sphere": trimesh.primitives.Sphere(radius=0.03, subdivisions=5),
    "capsule": trimesh.primitives.Capsule(radius=0.03, height=0.1),
    "box": trimesh.primitives.Box(extents=(0.1, 0.06, 0.03)),
}
keeps_density = {"capsule", "box"}

print("trimesh", trimesh.__version__)
assert "The density of the mesh used in inertia calculations." in trimesh.Trimesh.density.__doc__
for name, body in bodies.items():
    plain = body.to_mesh()
    for mesh in (body, plain):
        mesh.density = DENSITY
    true = plain.moment_inertia
    centre = trimesh.transformations.translation_matrix(body.center_mass)
    found = {
        "moment_inertia": np.trace(body.moment_inertia) / np.trace(true),
        "principal components": body.principal_inertia_components.sum() / np.trace(true),
        "mass_properties": np.trace(body.mass_properties.inertia) / np.trace(true),
        "moment_inertia_frame": np.trace(body.moment_inertia_frame(centre)) / np.trace(true),
    }
    ratios = ", ".join(f"{way} {ratio:.4g}" for way, ratio in found.items())
    print(f"{name} of {1000 * body.mass:.0f} g, its inertia over that of the mesh: {ratios}")
    assert np.isclose(body.mass, plain.mass) and np.isclose(body.mass, DENSITY * body.volume, rtol=0.01)
    wrong = 1.0 if name in keeps_density else 1 / DENSITY
    assert np.isclose(found["moment_inertia"], wrong, rtol=0.01), found
    assert np.isclose(found["principal components"], wrong, rtol=0.01), found
    assert np.isclose(found["mass_properties"], 1) and np.isclose(found["moment_inertia_frame"], 1), found

    scaled = np.trace(body.moment_inertia * (body.mass / body.volume)) / np.trace(true)
    print(f"  scaled by mass / volume: times {scaled:.4g}")
    assert np.isclose(scaled, DENSITY if name in keeps_density else 1, rtol=0.02), scaled

# the tensor of a solid cylinder by its formula
can = bodies["cylinder"]
mass, radius, height = can.mass, 0.03, 0.1
formula = mass * np.array([radius**2 / 4 + height**2 / 12, radius**2 / 4 + height**2 / 12, radius**2 / 2])
print("can by formula", formula.round(7), "by trimesh", np.diag(can.moment_inertia).round(10), "kg m2")
assert np.allclose(np.diag(can.moment_inertia) * DENSITY, formula, rtol=0.01)
END
"$place/bin/python" "$place/try.py"
