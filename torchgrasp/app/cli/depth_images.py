"""The commands `torchgrasp cloud depth` and `cloud scene`: a cloud or a scene from a depth image,
or from a cloud.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from torch import Tensor

from torchgrasp.app.cli.command import Command, arguments, option, positional, required
from torchgrasp.app.cli.inputs import OUT_CLOUD_HELP, ViewOptions, read_table, read_up
from torchgrasp.app.report.scene_picture import draw_scene
from torchgrasp.cloud import save_cloud
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.cloud.pose import read_pose
from torchgrasp.cloud.safe_files import read_image_file, read_intrinsics
from torchgrasp.cloud.sensor import median_depth
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import LEAST, Range
from torchgrasp.scene.file import save_scene
from torchgrasp.scene.image import is_scene
from torchgrasp.scene.masks import read_labels, read_mask
from torchgrasp.scene.scene import Scene

DEPTH_HELP = (
    "image along the optical axis (.png of 16 bit, .tiff, .exr, .npy, or .npz with an array "
    '"depth"). Integers are millimetres, floats metres; 0 and NaN are not measured'
)
INTRINSICS_HELP = (
    "fx fy cx cy in pixels, at the image's own resolution, and of a crop its width height. Or a "
    "file of ROS, Open3D, RealSense, Zivid or BOP (.json, .yaml), or with a matrix (.npy, .txt)"
)
DepthUnit = Annotated[float, Range(LEAST, 1.0, "metres of one count, above 0 and at most 1")]


@arguments(points="depth", path="out")
class _DepthCommand(Command):
    """A command that reads a depth image; these are its arguments."""

    depth: Path = positional(DEPTH_HELP)
    intrinsics: tuple[str, ...] = required(INTRINSICS_HELP)
    depth_unit: DepthUnit | None = option(
        None,
        "metres of one count of the depth: 0.0001 of a RealSense D405, 0.00025 of an L515, 0.001 "
        "of float mm",
    )
    out: Path = required(OUT_CLOUD_HELP)
    mask: Path | None = option(
        None,
        "mask of the object, of the depth's size and not 0 there, for `cloud scene` also of "
        "several objects. It is a picture with a colour or a number for each (.png, .tiff, .npy), "
        "masks (.npy, .npz), or COCO's run lengths (.json). By default every point is kept, or "
        "every object of a scene is found",
    )
    camera_pose: Path | None = option(
        None,
        "file with frame_from_camera, 4 x 4 (.npy or .txt); by default results are in the "
        "camera's frame",
    )
    up: tuple[float, float, float] | None = option(
        None, "roughly against gravity, in the frame of the results"
    )
    frames: tuple[Path, ...] = option(
        (),
        "more depth images of the camera, which stands still: the median of each pixel has less "
        "noise",
    )

    @property
    def vertical(self) -> Tensor | None:
        """The unit vector (3,) that points up, in the frame of the results; None without --up."""
        return read_up(self.up)

    def images(self):
        """Return depth image, intrinsics, mask labels and camera pose; what is not given is None.

        The depth image (h, w) is in the unit of the file; with --frames it is the median of all
        files. The intrinsics are numbers or a matrix [pixels], the labels (h, w) integers, and the
        pose a matrix (4, 4) [m].
        """
        camera = self.intrinsics
        if len(camera) == 1:
            camera = read_intrinsics("intrinsics", Path(camera[0]), self.depth.stem)
        else:
            try:
                camera = [float(word) for word in camera]
            except ValueError as error:
                raise BadArgument(
                    "intrinsics", " ".join(camera), "fx fy cx cy, or a file"
                ) from error
        mask = None if self.mask is None else read_image_file("mask", self.mask)
        pose = None if self.camera_pose is None else read_pose("camera_pose", self.camera_pose)
        depth = read_image_file("depth", self.depth)
        if self.frames:
            depth = median_depth([depth, *(read_image_file("depth", path) for path in self.frames)])
        size = tuple(
            depth.shape[-3:-1] if depth.ndim == 3 and depth.shape[-1] == 1 else depth.shape[-2:]
        )
        if mask is not None:
            mask = read_labels(mask, size, "mask")
        return depth, camera, mask, pose


@arguments()
class CloudDepth(_DepthCommand):
    """Write the point cloud of a depth image, with the camera as viewpoint."""

    def run(self) -> int:
        """Convert the depth image and write the cloud; return the exit code 0."""
        depth, camera, mask, pose = self.images()
        inside = None if mask is None else read_mask(mask, tuple(mask.shape))
        cloud = cloud_from_depth(depth, camera, inside, pose, self.depth_unit, self.vertical)
        save_cloud(cloud, self.out)
        frame = (
            "the camera's frame: give its vertical with --up"
            if pose is None
            else "the frame of the pose"
        )
        print(f"{len(cloud)} points in {frame}, {self.out}")
        return 0


@arguments(labels="mask", cloud="depth")
class CloudScene(_DepthCommand):
    """Write a scene with table and objects from a depth image or a cloud for `torchgrasp grasp`;
    draw its picture.

    See docs/real_camera.md.
    """

    depth: Path = positional(
        f"{DEPTH_HELP}; or, without --intrinsics, a cloud of one view (.pcd, .ply, .npz, .npy)"
    )
    intrinsics: tuple[str, ...] = option((), INTRINSICS_HELP)
    viewpoint: tuple[float, float, float] | None = option(
        None, "position of the camera [m] in the frame of the cloud; by default the file's"
    )
    unit: Literal["m", "cm", "mm"] = option("m", "unit of the numbers in the file of a cloud")
    out: Path = required(
        "scene to write (.npz); beside it a .png shows the table, objects and obstacles"
    )
    table: tuple[float, ...] | None = option(
        None,
        "height z of the table, or four numbers nx ny nz d of the plane n . p = d [m]. By default "
        "it is found",
    )
    point: tuple[float, ...] | None = option(
        None, "column and row of a pixel on the target, or x y z [m] of a point on it"
    )

    def run(self) -> int:
        """Find the table and the objects, write the scene and its picture; return the exit code 0.

        Raises `BadArgument` if the picture, OUT with the ending .png, would replace an input.
        """
        picture = self.out.with_suffix(".png")
        if picture.resolve() in [
            path.resolve() for path in (self.depth, self.mask, *self.frames) if path
        ]:
            raise BadArgument(
                "--out", f"{self.out}, whose picture would replace {picture}", "another name"
            )
        seen = self._of_image() if self.intrinsics else self._of_cloud()
        save_scene(seen, self.out)
        draw_scene(seen, picture)
        for label in seen.things:
            print(
                f"object {label}: {int(seen.rows_of(label).sum())} "
                f"points{' (the target)' * (label == seen.target)}"
            )
        said = [f"table: {'unknown' if seen.table is None else seen.table.describe()}"]
        noise = seen.noise
        depth = seen.image.depth
        if noise is not None:
            random = 1e3 * float(noise.sigma(depth[depth > 0].median()))
            said.append(
                f"noise: {random:.1f} mm of single pixels, {1e3 * noise.bias:.1f} mm of patches"
            )
        said += [f"note: {sentence}" for sentence in seen.notes] + [
            f"advice: {sentence}" for sentence in seen.advice
        ]
        print(*said, f"{self.out}, {picture}", sep="\n")
        return 0

    def _of_image(self) -> Scene:
        """Return the scene that the command's depth image shows."""
        if self.viewpoint is not None or self.unit != "m":
            raise BadArgument(
                "--intrinsics", "--viewpoint or --unit beside it", "--camera-pose or --depth-unit"
            )
        depth, camera, mask, pose = self.images()
        table = None if self.table is None else read_table(self.table)
        chosen = "mask" if mask is None or len(mask[mask > 0].unique()) < 2 else "labels"
        given = {"point": self.point, "table": table, "depth_unit": self.depth_unit, chosen: mask}
        return Scene.from_depth(depth, camera, pose, **given, up=self.vertical)

    def _of_cloud(self) -> Scene:
        """Return the scene that the command's point cloud shows."""
        if self.depth.suffix.lower() in (".png", ".tif", ".tiff", ".exr") or is_scene(self.depth):
            raise BadArgument("--intrinsics", "none", "fx fy cx cy of the depth image, or a file")
        for name, given in (
            ("mask", self.mask),
            ("frames", self.frames),
            ("depth-unit", self.depth_unit),
        ):
            if given:
                raise BadArgument(
                    f"--{name}",
                    "an option of depth images beside a cloud",
                    "--point X Y Z, or --unit",
                )
        if self.point is not None and len(self.point) != 3:
            raise BadArgument(
                "--point", f"{len(self.point)} numbers", "x y z [m] of a point in the cloud"
            )
        given: Any = {
            "viewpoint": self.viewpoint,
            "unit": self.unit,
            "camera_pose": self.camera_pose,
        }
        file = ViewOptions(**given).read("DEPTH", self.depth, whole=True)
        table = file.table if self.table is None else read_table(self.table)
        seen = Scene.from_cloud(file.cloud, point=self.point, table=table, up=self.vertical)
        return dataclasses.replace(seen, notes=(*file.notes, *seen.notes))
