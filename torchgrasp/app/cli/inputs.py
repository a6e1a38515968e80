"""Arguments that several commands share: reading of cloud files, the table, the hand, and output
folders.
"""

import contextlib
import dataclasses
import importlib
import importlib.util
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from torchgrasp.app.cli.command import arguments, naming, option
from torchgrasp.cloud import Advice, CloudFile, check_cloud, diagnose_cloud, read_cloud_file
from torchgrasp.cloud.neighbours import draw_rows, find_inliers
from torchgrasp.cloud.parts import cut_exact_table
from torchgrasp.cloud.pose import read_camera_pose, read_pose, tell_far, tell_inverse
from torchgrasp.contacts.region import Region
from torchgrasp.files import hold_folder
from torchgrasp.foundation.checks import check_tensor
from torchgrasp.foundation.errors import BadArgument, MissingExtra, OutputError
from torchgrasp.foundation.limits import MAX_EXTENT
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.linalg import norm, unit
from torchgrasp.geometry.plane import Plane, as_plane, move
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import PointCloud
from torchgrasp.values.specs import Simulator

WIDEST = 1.5  # tangent of half an angle of view wider than that of depth cameras
MOST_UNSEEN = 0.01  # share of the points outside: more, and the cloud is in another frame
LEVEL = 0.9  # least upward part of a table's unit normal where x and y say where its edge is
MOST_POINTS = 100_000  # most points of a file that are used; a shape is fitted to fewer
CLOUD_HELP = "point cloud of one object (.ply, .pcd, .npy, .npz, or text as .xyz, .csv, .pts)"
OUT_CLOUD_HELP = "point cloud to write (.npz or .ply), in metres"
HAND_HELP = "name of a shipped hand (allegro, barrett, leap, shadow), or the folder of another hand"
FINGERS_HELP = (
    "fingers that grasp: an option of the hand, a number of fingers, "
    "or names as in index,middle,thumb"
)
STARTS_HELP = "random initial guesses of the contact planner"
SEED_HELP = "random seed"


def read_up(up: tuple[float, float, float] | None) -> Tensor | None:
    """Return the unit vector (3,) along the direction of --up; None for None.

    Raises `BadArgument` for a direction of length zero, or one that is not finite.
    """
    if up is None:
        return None
    vector = check_tensor("--up", real(up), (3,))
    if not vector.any():
        raise BadArgument("--up", "a vector of length zero", "the direction that points up")
    return unit(vector)


@arguments()
class ViewOptions:
    """Options for reading the file of a cloud: camera, normals, unit, vertical."""

    viewpoint: tuple[float, float, float] | None = option(
        None,
        "position of the camera [m] in the frame of the cloud; by default the file's, else an "
        "estimate",
    )
    no_viewpoint: bool = option(False, "estimate the camera's position instead of using the file's")
    no_normals: bool = option(False, "fit normals instead of using the file's")
    unit: Literal["m", "cm", "mm"] = option(
        "m", "unit of the numbers in the file; options and results are in metres"
    )
    up: tuple[float, float, float] | None = option(
        None, "vertical direction, of any length; by default z"
    )
    camera_pose: Path | None = option(
        None,
        "file with frame_from_camera, 4 x 4 (.npy or .txt), for a cloud in the camera's frame. Its "
        "axes are x right, y down, z forward. The cloud is moved into the pose's frame. Results are "
        "in this frame, and the camera is known",
    )

    @property
    def vertical(self) -> Tensor | None:
        """The unit vector (3,) that points up, in the frame of the cloud; None means the z axis.

        Raises `BadArgument` for an --up of length zero.
        """
        return read_up(self.up)

    def read(self, name: str, path: Path, whole: bool = False) -> CloudFile:
        """Return the cloud [m] in the file at `path`, read as the options say.

        It is in the frame of the file; with --camera-pose, it is moved into the frame in which this
        pose is given. By default it is checked, and at most 100,000 random points (`MOST_POINTS`)
        are kept. With `whole`, clouds of any size and extent are accepted, and all points are kept.
        Raises `BadArgument` for options that exclude each other, and for an unusable cloud. It
        calls the file `name`.
        """
        if self.viewpoint is not None and (self.no_viewpoint or self.camera_pose is not None):
            raise BadArgument(
                "--viewpoint", "--no-viewpoint or --camera-pose beside it", "one of them"
            )
        with naming(path=name, points=name, normals=name, viewpoint="--viewpoint"):
            file = read_cloud_file(path, self.viewpoint, self.unit)
            cloud = file.cloud
            notes = file.notes
            table = file.table
            if self.no_viewpoint:
                cloud = dataclasses.replace(cloud, viewpoint=None, frustum=None)
            if self.no_normals:
                cloud = dataclasses.replace(cloud, normals=None)
            if self.camera_pose is not None:
                pose = read_pose("--camera-pose", self.camera_pose)
                with naming(camera_pose="--camera-pose"):
                    pose = read_camera_pose(pose)
                notes = (*notes, *tell_far(pose))
                notes += tell_inverse(pose) if self.up is None else ()
                cloud = _move(name, cloud, pose)
                table = table and table.moved(pose)
                # the pose tells where the camera is, whatever the file says
                told = ("default viewpoint", "VIEWPOINT is elsewhere")
                notes = tuple(note for note in notes if not any(said in note for said in told))
            if not whole:
                check_cloud(cloud)
                if len(cloud) > MOST_POINTS:
                    notes = (
                        *notes,
                        f"{MOST_POINTS} of {len(cloud)} points, drawn at random, are used",
                    )
                    cloud = cloud.select(draw_rows(len(cloud), MOST_POINTS))
        if table is not None:
            notes = (
                *notes,
                f"the file holds a {describe_table(table)}, which --table or --no-table replaces",
            )
        return CloudFile(cloud, notes, table)


@arguments()
class CloudOptions(ViewOptions):
    """Options for reading the file of a cloud, and for the table."""

    table: tuple[float, ...] | None = option(
        None,
        "height of the table along the vertical, or four numbers nx ny nz d of the plane n . p = "
        "d [m]. By default the table is the file's, as `cloud cut` writes it. Else it is at the "
        "lowest point of the cloud that is no outlier",
    )
    no_table: bool = option(False, "there is no table")

    def with_table_of(self, file: CloudFile) -> "CloudOptions":
        """Return these options with the table that a cloud's file states as --table.

        They are returned unchanged if --table or --no-table is given, or if the file has no table.
        """
        if file.table is None or self.table is not None or self.no_table:
            return self
        known: Any = {**vars(self), "table": (*file.table.normal.tolist(), file.table.offset)}
        return CloudOptions(**known)

    def read_standing(
        self, name: str, path: Path, whole: bool = False
    ) -> "tuple[CloudFile, CloudOptions]":
        """Return the cloud [m] in the file at `path` without its table, and these options with the
        table that the file states.

        The cloud is that of `read`. Points are left out that lie exactly in the plane of a table.
        """
        file = without_exact_table(self.read(name, path, whole), self.vertical)
        return file, self.with_table_of(file)

    @property
    def given_table(self) -> Plane | float | None:
        """The table of --table in the frame of the cloud; None if it is not given.

        It is a plane, or a height z [m]. With --up, a height along this direction gives a plane.
        Raises `BadArgument` for another count of numbers than one or four, or a normal of length
        zero.
        """
        if self.table is None:
            return None
        given = read_table(self.table)
        return given if isinstance(given, Plane) else self._at(given)

    def _at(self, height: float) -> Plane | float:
        """Return the level plane at a height [m] along the vertical."""
        return height if self.vertical is None else Plane(self.vertical, height)

    def plane(self, cloud: PointCloud) -> Plane | float | None:
        """Return the table in the frame of the cloud: a plane, a height z [m], or None.

        None means no table (--no-table). By default the table is at the lowest point of the cloud
        that is no outlier. Raises `BadArgument` for --table and --no-table together.
        """
        table = self.table
        if table is not None and self.no_table:
            raise BadArgument(
                "--table", f"{' '.join(f'{x:g}' for x in table)} and --no-table", "one of the two"
            )
        if self.no_table:
            return None
        if table is not None:
            return self.given_table
        up = self.vertical
        seen = cloud.points[find_inliers(cloud.points.double())]
        return self._at(float((seen[:, 2] if up is None else seen.double() @ up).min()))

    def given_vertical(self, plane: Plane | None) -> Tensor | None:
        """Return the unit vector (3,) of --up, else the normal of --table; None without both.

        The vector points up, in the frame of the cloud. `plane` is the table in this frame; None
        means no table.
        """
        if self.up is not None or self.table is None or plane is None:
            return self.vertical
        return plane.normal

    def judge(self, cloud: PointCloud, table: Plane | float | None) -> tuple[Advice, ...]:
        """Return advice on the quality of a cloud, such as on noise or a missing side; () if it is
        good.

        `table` is a plane, a height z [m], or None for no table, in the frame of the cloud. Raises
        `BadArgument` for a fault with which no grasp should be planned, such as a wrong unit.
        """
        plane = as_plane(table)
        up = self.given_vertical(plane)
        with naming(points="CLOUD", normals="CLOUD"):
            advice = diagnose_cloud(cloud, up, plane, stands=plane is not None).advice
        for bad in advice:
            if bad.refused:
                raise BadArgument("CLOUD", bad.found, bad.fix)
        return advice


def read_table(table: tuple[float, ...]) -> Plane | float:
    """Return the table in the frame of the cloud, from the numbers of the option --table.

    One number is a height [m] along z, and is returned as it is. Four numbers give a plane. They
    are a vector n along the normal, of any length, and d. Points p [m] of the table have n . p = d.
    Raises `BadArgument` for another count of numbers, or a normal of length zero.
    """
    if len(table) not in (1, 4):
        raise BadArgument(
            "--table", f"{len(table)} numbers", "a height, or four: a normal and its distance"
        )
    numbers = check_tensor("--table", real(table), (len(table),))
    if len(numbers) == 1:
        return float(numbers[0])
    length = norm(numbers[:3])
    if not length > 0:
        raise BadArgument("--table", "a normal of length zero", "the direction that points up")
    return Plane(numbers[:3] / length, float(numbers[3] / length))


def with_edge(table: Plane | float | None, edge: tuple[float, ...]) -> Plane:
    """Return a table, a plane or a height z [m], that ends at the edge of --edge.

    All are in the frame of the cloud. `edge` holds a point on the edge [m] and the direction away
    from the table. Each has x and y, or x, y and z. Raises `BadArgument` without a table, for
    another count of numbers, or for a direction of length zero. With x and y alone, it is also
    raised if z is not up.
    """
    plane = as_plane(table)
    if plane is None:
        raise BadArgument("--edge", "--no-table beside it", "one of the two")
    if len(edge) not in (4, 6):
        wanted = "X Y OX OY, a point on the edge and the direction away from the table"
        raise BadArgument("--edge", f"{len(edge)} numbers", wanted)
    numbers = check_tensor("--edge", real(edge), (len(edge),))
    point, outward = numbers.chunk(2)
    if not outward.any():
        wanted = "the direction away from the table"
        raise BadArgument("--edge", "a direction of length zero", wanted)
    if len(edge) == 4:
        normal = plane.normal.double()
        if not float(normal[2]) > LEVEL:
            raise BadArgument("--edge", "four numbers where z is not up", "six: X Y Z OX OY OZ")
        z = (plane.offset - normal[:2] @ point) / normal[2]
        point = torch.cat([point, z[None]])
        outward = torch.cat([outward, real([0.0])])
    with naming(outward="--edge"):
        return plane.ending(point, outward)


def _move(name: str, cloud: PointCloud, pose: Tensor) -> PointCloud:
    """Return a cloud moved from the camera's frame to the pose's frame; raise `BadArgument` if it
    is in another.
    """
    outside = cloud.points[:, :2].abs().amax(1) >= WIDEST * cloud.points[:, 2]
    unseen = float(outside.double().mean())
    if unseen > MOST_UNSEEN:
        allowed = (
            "a cloud in the camera's frame (z forward) for --camera-pose; "
            "in another frame, --viewpoint X Y Z"
        )
        raise BadArgument(name, f"{unseen:.0%} of the points out of a camera's sight", allowed)
    return dataclasses.replace(move(cloud, pose), viewpoint=pose[:3, 3].clone())


def read_region(name: str, text: str | None) -> Region | None:
    """Return the region of space that the text of the option `name` describes; None for None.

    The text is the path of a closed mesh, or six numbers of a box. These are its least, then its
    greatest corner (x, y, z). Both are in metres, in the frame of the cloud. A note is printed for
    a box whose sides are all above 2 m. Raises `BadArgument` for another count or order of numbers,
    or an unusable mesh.
    """
    with naming(mesh=name, low=name, high=name):
        try:
            numbers = real([float(word) for word in (text or "").split()])
        except ValueError:
            return Region.mesh(Path(str(text)))
        if text is not None and len(numbers) != 6:
            raise BadArgument(
                "mesh", repr(text), "six numbers of a box, or the file of a closed mesh"
            )
        if text is None:
            return None
        sides = (numbers[3:] - numbers[:3]).abs()
        if float(sides.min()) > MAX_EXTENT:
            shown = " x ".join(f"{side:g}" for side in sides.tolist())
            print_notes((f"{name}: a box of {shown} m: its numbers are metres, also with --unit",))
        return Region.box(numbers[:3], numbers[3:])


def read_distribution(name: str, text: str) -> float | Distribution:
    """Return the number or the distribution that the text of the option `name` holds.

    Examples are "0.5", the interval "0.3:0.8", and "0.2|0.8" for two values of equal probability.
    Raises `BadArgument`, which names the option, for another text.
    """
    with naming(text=name, parts=name, weights=name):
        return Distribution.read(text)


def without_exact_table(file: CloudFile, up: Tensor | None) -> CloudFile:
    """Return a cloud without the points of its table, if they lie exactly in a plane.

    Only a simulator gives such points: half of them are within 0.02 mm of a plane. This plane
    becomes the `table` of the result, and a note says so. Any other cloud, and one whose table is
    known, is returned unchanged. `up` (3,) is the unit vector that points up, in the frame of the
    cloud; None means the z axis.
    """
    if file.table is not None:
        return file
    cloud, plane = cut_exact_table(file.cloud, real([0.0, 0.0, 1.0]) if up is None else up)
    if plane is None:
        return file
    count = len(file.cloud) - len(cloud)
    note = f"{count} points of a table without noise are left out: {describe_table(plane)}"
    return CloudFile(cloud, (*file.notes, note), plane)


def print_notes(notes: tuple[str, ...], advice: tuple[Advice, ...] = ()) -> None:
    """Print notes on how a file was read, and advice on the cloud, a line for each."""
    for note in notes:
        print(f"{'note':8}{note}")
    for one in advice:
        print(f"{'advice':8}{one!s}")


def check_folder(path: Path) -> None:
    """Raise `OutputError` if no file can be written in a folder, by a test with a temporary file.

    A missing folder is created for the test, and removed again.
    """
    made: list[Path] = []
    try:
        for folder in reversed([path, *path.parents]):
            if not folder.exists():
                folder.mkdir()
                made.append(folder)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OutputError(
            "--out", f"{path} ({error.strerror or error})", "a folder that can be written"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # an empty folder may stay
            for folder in reversed(made):
                folder.rmdir()


@contextlib.contextmanager
def holding(
    name: str, path: Path | None, hold: Callable[[Path], AbstractContextManager[None]] = hold_folder
) -> Iterator[None]:
    """Within the context, lock the folder or file at `path` against other runs.

    `hold(path)` returns the context that locks it: `hold_folder` by default, `hold_file` for a
    file. A `path` of None locks nothing. Raises `OutputError`, which names the option `name`, if
    another run has the lock or nothing can be written.
    """
    with contextlib.ExitStack() as held:
        if path is not None:
            with naming(folder=name, path=name):
                held.enter_context(hold(path))
        yield


def load_fingers(hand: str, fingers: str) -> tuple[Hand, Literal["auto"] | None]:
    """Return the hand with its chosen fingers, then "auto" if the planner is to try all its sets of
    fingers, else None.

    `hand` is a name or a folder. `fingers` is the name of a set in its hand.toml ("default"), a
    number of fingers ("4"), or names ("index,middle,thumb"). Or it is "auto"; then the hand has its
    default fingers. Raises `BadArgument`, which names --hand or --fingers, for an unknown one.
    """
    with naming(hand="--hand", name="--hand", name_or_path="--hand", fingers="--fingers"):
        return (load_hand(hand), "auto") if fingers == "auto" else (load_hand(hand, fingers), None)


def describe_table(table: Plane | float) -> str:
    """Return a text that says where a table is: a plane, or a height z [m]."""
    if isinstance(table, Plane):
        x, y, z = (0.0 + round(n, 3) for n in table.normal.tolist())
        return f"table at {table.offset:.3f} m along ({x:g}, {y:g}, {z:g})"
    return f"table at z = {table:.3f} m"


def object_name(path: Path) -> str:
    """Return a name for the object in a file: the file's name without its ending, such as "jug".

    For mesh.ply, view0.ply and the like it is the name of the file's folder. For files called
    cloud, model, points or scan it is "object in cloud.ply", with the file's name.
    """
    if re.fullmatch(r"(mesh|view\d*)(_noisy)?", path.stem):
        return path.resolve().parent.name or "object"
    generic = path.stem in ("cloud", "model", "points", "scan")
    return f"object in {path.name}" if generic else path.stem


def import_simulator(name: Simulator = "sapien") -> None:
    """Import a simulator, so that later steps do not fail for want of it.

    Raises `MissingExtra` if it is not installed, and `BadArgument` if it cannot be loaded.
    """
    if importlib.util.find_spec(name) is None:
        raise MissingExtra(name, "sim" if name == "sapien" else name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing Vulkan does not concern physics
            importlib.import_module(name)
    except ImportError as error:
        allowed = (
            "a simulator with its system libraries (Debian and Ubuntu: apt-get install libx11-6)"
        )
        raise BadArgument(
            "--close", f"a {name} that cannot be loaded ({error})", allowed
        ) from error
