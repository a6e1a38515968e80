"""A folder of boxes and cylinders to drop, and scenes of them."""

import trimesh


def write_objects(folder):
    """Six convex objects as NAME/mesh.ply, standing at z = 0."""
    shapes = {
        "brick": trimesh.creation.box([0.05, 0.07, 0.09]),
        "cube": trimesh.creation.box([0.05, 0.05, 0.05]),
        "tin": trimesh.creation.cylinder(radius=0.03, height=0.09),
        "disc": trimesh.creation.cylinder(radius=0.045, height=0.03),
        "ball": trimesh.creation.icosphere(subdivisions=2, radius=0.03),
        "slab": trimesh.creation.box([0.10, 0.06, 0.03]),
    }
    for name, mesh in shapes.items():
        mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
        (folder / name).mkdir(parents=True)
        mesh.export(folder / name / "mesh.ply")
    return folder
