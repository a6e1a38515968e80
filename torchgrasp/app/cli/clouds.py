"""The commands `torchgrasp cloud` and `shape`: check, cut, thin and render clouds; write the
estimated surface.
"""

from pathlib import Path
from typing import Annotated, Literal

import torch

from torchgrasp import cloud as clouds
from torchgrasp.app.cli import inputs
from torchgrasp.app.cli.command import (
    Command,
    ForPrograms,
    answer,
    arguments,
    naming,
    nested,
    option,
    positional,
    required,
)
from torchgrasp.cloud.neighbours import draw_rows
from torchgrasp.cloud.prepare import prepare_cloud
from torchgrasp.data import write_objects
from torchgrasp.data.shipped import find_view
from torchgrasp.export import check_surface_path, largest_std, save_surface
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Range, Seed
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.plane import as_plane
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.planning import PointCloud

MOST_TRIED = 20_000  # points with which a camera is sought: more give no more certainty


@arguments(points="file", normals="file")
class CloudCheck(ForPrograms):
    """Report on a point cloud, with advice for a better one. The exit code is 1 if `torchgrasp
    grasp` refuses it.
    """

    file: Path = positional(inputs.CLOUD_HELP)
    view: inputs.CloudOptions = nested(inputs.CloudOptions())

    def run(self) -> int:
        """Check the cloud and print the report; return the exit code."""
        notes, report, unseen = self.judge()
        print(clouds.format_report(report))
        for note in notes:
            print(f"{'note':12}{note}")
        for advice in unseen:
            print(f"{'refused':12}{advice}")
        found = (*report.advice, *unseen)
        refused = any(advice.refused for advice in found)
        measured = {
            "points": report.points,
            "size_m": report.size,
            "spacing_m": report.spacing,
            "noise_m": report.noise,
            "outliers": report.outliers,
            "viewpoint_given": report.viewpoint_given,
        }
        advice = [vars(one) for one in found]
        answer({"refused": refused, "advice": advice, "notes": notes, **measured})
        return int(refused)

    def judge(self) -> tuple[tuple[str, ...], clouds.CloudReport, tuple[clouds.Advice, ...]]:
        """Return notes on how the file was read, a report on the cloud's quality, and refusals.

        The refusals are one `Advice` if no single camera could have seen the cloud, and () if one
        could. They are also () if the report already refuses the cloud. Raises `BadArgument` for a
        file that cannot be read.
        """
        file, view = self.view.read_standing("FILE", find_view(self.file, "FILE"), whole=True)
        plane = as_plane(view.plane(file.cloud))
        up = view.given_vertical(plane)
        known = plane if view.table is not None else None
        report = clouds.diagnose_cloud(file.cloud, up, known, stands=not view.no_table)
        refused = any(advice.refused for advice in report.advice)
        error = None if refused else _no_view(file.cloud)
        if error is None:
            return file.notes, report, ()
        unseen = clouds.Advice(str(error.found), error.allowed, refused=True)
        return file.notes, report, (unseen,)


def _no_view(cloud: PointCloud) -> BadArgument | None:
    """Return the error of `fit_shape` for a cloud that no single camera can see. Return None if one
    camera can see it.
    """
    some = cloud.select(draw_rows(len(cloud), MOST_TRIED))
    try:
        seen = prepare_cloud(some, torch.Generator().manual_seed(0))
        if seen.one_sided:
            silhouettes(PointCloud(seen.points, seen.normals, seen.viewpoint))
    except BadArgument as error:
        return error
    return None


@arguments(points="cloud", path="out")
class CloudCut(Command):
    """Write the points of one object in a scene, without those of the table, and the plane of the
    table.

    Both go into the same file; the plane is also printed. Point and box are in metres, in the frame
    of the cloud. Points outside the box are left out.
    """

    cloud: Path = positional(
        "point cloud of a scene of any size (.ply, .pcd, .npy, .npz, or text as .xyz, .csv, .pts)"
    )
    out: Path = required(inputs.OUT_CLOUD_HELP)
    view: inputs.ViewOptions = nested(inputs.ViewOptions())
    point: tuple[float, float, float] | None = option(
        None,
        "a point [m] on or near the object; points farther than 0.5 m away are left out. By "
        "default the largest",
    )
    box: tuple[float, float, float, float, float, float] | None = option(
        None, "two corners [m] of a box; points outside are left out first"
    )
    gap: Annotated[float, Range(0.001, 1.0)] = option(
        0.02, "least distance between two objects [m]"
    )

    def run(self) -> int:
        """Cut the object out of the cloud and write its points; return the exit code 0."""
        file = self.view.read("CLOUD", self.cloud, whole=True)
        near = None if self.point is None else real(self.point)
        box = None if self.box is None else real(self.box).reshape(2, 3)
        up = self.view.vertical
        up = real([0.0, 0.0, 1.0]) if up is None else up
        thing, plane = clouds.cut_object(file.cloud, up, near, box, self.gap)
        clouds.save_cloud(thing, self.out, plane)
        inputs.print_notes(file.notes)
        if plane is None:
            print("note    no plane was found under the object")
        else:
            x, y, z = plane.normal.tolist()
            print(
                f"table   --table {x:.5f} {y:.5f} {z:.5f} {plane.offset:.5f} ({self.out} holds it)"
            )
        print(f"{len(thing)} of {len(file.cloud)} points, {self.out}")
        return 0


@arguments(points="cloud", path="out")
class CloudThin(Command):
    """Write one point per voxel, without outliers such as flying pixels."""

    cloud: Path = positional(inputs.CLOUD_HELP)
    out: Path = required(inputs.OUT_CLOUD_HELP)
    voxel: float = option(0.002, "side of a voxel [m]")
    view: inputs.ViewOptions = nested(inputs.ViewOptions())

    def run(self) -> int:
        """Thin the cloud, remove outliers and write the rest; return the exit code 0."""
        file = self.view.read("CLOUD", self.cloud, whole=True)
        some = clouds.voxel_downsample(file.cloud, self.voxel)
        less = clouds.remove_outliers(some)
        clouds.save_cloud(less, self.out, file.table)
        inputs.print_notes(file.notes)
        print(
            f"{len(less)} of {len(file.cloud)} points, {len(some) - len(less)} outliers removed, "
            f"{self.out}"
        )
        return 0


@arguments(n="points", depth="mesh")
class CloudRender(Command):
    """Write the point cloud that a depth camera sees of a mesh."""

    mesh: Path = positional("closed mesh of an object [m], z up (.ply, .obj, .stl, ...)")
    out: Path = required(f"{inputs.OUT_CLOUD_HELP}, with the viewpoint")
    azimuth: float = option(
        30.0, "direction of the camera from the mesh, from x towards y [degrees]"
    )
    elevation: float = option(30.0, "elevation of the camera above the horizontal [degrees]")
    distance: float = option(0.5, "distance of the camera from the centre of the mesh [m]")
    points: int = option(1000, "number of points; fewer if fewer pixels see the object")
    no_noise: bool = option(False, "an exact camera instead of an active stereo camera")
    seed: Seed = option(0, inputs.SEED_HELP)

    def run(self) -> int:
        """Render the mesh by a simulated depth camera, write the cloud; return the exit code 0."""
        with naming(points="MESH"):
            solid = read_mesh(self.mesh)
            pose = clouds.look_at(self.azimuth, self.elevation, self.distance, solid)
            cloud = clouds.partial_view(solid, pose, self.points, not self.no_noise, self.seed)
        with naming(path="--out"):
            clouds.save_cloud(cloud, self.out)
        print(f"{len(cloud)} points, {self.out}")
        return 0


@arguments(mesh="meshes", path="out")
class CloudViews(Command):
    """Make a folder of objects for trials from a folder of meshes: a noisy depth camera sees each
    mesh.
    """

    meshes: Path = positional("folder of closed meshes [m], z up (.ply, .stl, .obj, .off)")
    out: Path = required(
        "folder to write: manifest.json, and for each object mesh.ply and its views"
    )
    views: Annotated[int, Range(1, 1000)] = option(3, "views of each object, from random sides")
    seed: Seed = option(0, inputs.SEED_HELP)

    def run(self) -> int:
        """Render views of all meshes and write the folder of objects; return the exit code 0."""
        names = write_objects(self.meshes, self.out, self.views, self.seed)
        print(
            f"{len(names)} objects with {self.views} view{'s' * (self.views != 1)} each: {self.out}"
        )
        return 0


@arguments(points="cloud", normals="cloud", path="out")
class ShapeSurface(Command):
    """Write the estimated surface of an object, coloured by its standard deviation."""

    cloud: Path = positional(inputs.CLOUD_HELP)
    out: Path = required(
        'mesh to write: .ply, with the standard deviation of each vertex as "std_m" [m], or .glb'
    )
    view: inputs.CloudOptions = nested(inputs.CloudOptions())
    support: Literal["camera", "paper"] = option(
        "camera",
        "what stands in for the unseen side: an estimate of it, or the paper's distant points",
    )
    resolution: int = option(64, "cells along the diameter of the surface's domain, 8 to 256")
    seed: Seed = option(0, inputs.SEED_HELP)

    def run(self) -> int:
        """Fit the shape and write its surface as a mesh; return the exit code 0."""
        check_surface_path(self.out)
        file = self.view.read("CLOUD", find_view(self.cloud, "CLOUD"))
        table = self.view.with_table_of(file).plane(file.cloud)
        with naming(table="--table", viewpoint="--viewpoint", normals="CLOUD"):
            shape = fit_shape(file.cloud, support=self.support, seed=self.seed, table=table)
        estimate = extract_surface(shape, self.resolution)
        save_surface(estimate, self.out)
        inputs.print_notes(file.notes)
        middle = 1e3 * float(estimate.std_m.median())
        most = 1e3 * largest_std(estimate)
        print(f"{len(estimate.vertices)} vertices, {len(estimate.faces)} faces, {self.out}")
        print(f"standard deviation: median {middle:.1f} mm, {most:.1f} mm where it is yellow")
        return 0
