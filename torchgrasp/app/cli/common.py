"""Checks that the commands share, and errors that name the option."""

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor
from tyro.conf import arg

from torchgrasp.base import check_whole
from torchgrasp.checks import check_tensor
from torchgrasp.cloud import Advice, CloudFile, check_cloud, diagnose_cloud, read_cloud_file
from torchgrasp.cloud.depth import read_pose
from torchgrasp.cloud.neighbours import draw_rows, find_inliers
from torchgrasp.errors import BadArgument, OutputError
from torchgrasp.files import hold_folder
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.values import PointCloud

MOST_POINTS = 100_000
"""Most points of a file that are used: a shape is fitted to 2000 of them, after outliers are found among all."""


@contextlib.contextmanager
def naming(**options: str) -> Iterator[None]:
    """Name options in errors, by the argument that each stands for."""
    try:
        yield
    except BadArgument as error:
        argument = error.argument.split("[")[0]  # an item of a list has its place in brackets
        if argument not in options:
            raise
        raise type(error)(options[argument], error.found, error.allowed) from error


WIDEST = 1.5
"""Tangent of half the widest angle of view: that of 113 degrees, more than depth cameras have."""


def unsaid(metavar: str | None = None) -> Any:
    """Return how the help shows an option whose default says nothing."""
    return arg(metavar=metavar, help_behavior_hint="")


@dataclasses.dataclass(frozen=True)
class ViewOptions:
    """How the file of a cloud is meant.

    Args:
        viewpoint: position of the camera in metres in the frame of the cloud; by default the file's, else an estimate.
        no_viewpoint: estimate the camera in place of the file's.
        no_normals: fit normals in place of the file's.
        unit: of the numbers in the file; all options and results are in metres.
        up: the vertical in the frame of the cloud, of any length; by default z.
        camera_pose: file with frame_from_camera, 4 x 4 (.npy, or .txt), for a cloud in the camera's frame (x right,
            y down, z forward). The cloud is moved into the pose's frame. Results are there, and the camera is known.
    """

    viewpoint: Annotated[tuple[float, float, float] | None, unsaid("X Y Z")] = None
    no_viewpoint: Annotated[bool, unsaid()] = False
    no_normals: Annotated[bool, unsaid()] = False
    unit: Literal["m", "cm", "mm"] = "m"
    up: Annotated[tuple[float, float, float] | None, unsaid("X Y Z")] = None
    camera_pose: Annotated[Path | None, unsaid("PATH")] = None

    @property
    def vertical(self) -> Tensor | None:
        """The vertical, of unit length; None: z."""
        if self.up is None:
            return None
        vector = check_tensor("--up", torch.tensor(self.up, dtype=torch.float64), (3,))
        if not bool(vector.any()):
            raise BadArgument("--up", "a vector of length zero", "the direction that points up")
        return unit(vector)


AS_IT_IS = ViewOptions()
"""A cloud as its file says: metres, z up, with the file's viewpoint and normals."""


def read_view(option: str, path: Path, view: ViewOptions, whole: bool = False) -> CloudFile:
    """Read the cloud of an option as it is meant; `whole` takes scenes of any size and all their points."""
    if view.viewpoint is not None and (view.no_viewpoint or view.camera_pose is not None):
        raise BadArgument("--viewpoint", "--no-viewpoint or --camera-pose beside it", "one of them")
    with naming(path=option, points=option, normals=option, viewpoint="--viewpoint"):
        file = read_cloud_file(path, view.viewpoint, view.unit)
        cloud, notes = file.cloud, file.notes
        if view.no_viewpoint:
            cloud = PointCloud(cloud.points, cloud.normals)
        if view.no_normals:
            cloud = PointCloud(cloud.points, None, cloud.viewpoint, cloud.frustum)
        if view.camera_pose is not None:
            cloud = _move(option, cloud, read_pose("--camera-pose", view.camera_pose))
            notes = tuple(note for note in notes if "default viewpoint" not in note)
        if not whole:
            check_cloud(cloud)
            if len(cloud) > MOST_POINTS:
                notes = (*notes, f"{MOST_POINTS} of {len(cloud)} points, drawn at random, are used")
                cloud = cloud.select(draw_rows(len(cloud), MOST_POINTS))
    return CloudFile(cloud, notes)


def _move(option: str, cloud: PointCloud, pose: Tensor) -> PointCloud:
    """Move a cloud from its camera's frame."""
    aside = cloud.points[:, :2].abs().amax(1)
    unseen = float((aside >= WIDEST * cloud.points[:, 2]).double().mean())
    if unseen > 0.01:
        allowed = "a cloud in the camera's frame (z forward) for --camera-pose; in another frame, --viewpoint X Y Z"
        raise BadArgument(option, f"{unseen:.0%} of the points out of a camera's sight", allowed)
    normals = None if cloud.normals is None else rotate(pose, cloud.normals)
    frustum = None if cloud.frustum is None else rotate(pose, cloud.frustum)
    return PointCloud(apply(pose, cloud.points), normals, pose[:3, 3].clone(), frustum)


def judge_cloud(option: str, cloud: PointCloud, view: ViewOptions, table: Plane | float | None) -> tuple[Advice, ...]:
    """Return advice on a cloud; refuse what no grasp should be planned on. A table of None: there is none."""
    plane = as_plane(table)
    up = view.vertical if view.up is not None or plane is None else plane.normal
    with naming(points=option, normals=option):
        advice = diagnose_cloud(cloud, up, plane, stands=plane is not None).advice
    for bad in advice:
        if bad.refused:
            raise BadArgument(option, bad.found, bad.fix)
    return advice


def print_notes(notes: tuple[str, ...], advice: tuple[Advice, ...]) -> None:
    """Print what was left out of a file, and advice."""
    for name, sentence in [*(("note", n) for n in notes), *(("advice", str(a)) for a in advice)]:
        print(f"{name:8}{sentence}")


def check_folder(path: Path) -> None:
    """Refuse a folder that cannot be written, by a trial."""
    made: list[Path] = []
    try:
        for folder in reversed([path, *path.parents]):
            if not folder.exists():
                folder.mkdir()
                made.append(folder)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OutputError("path", f"{path} ({error.strerror or error})", "a folder that can be written") from error
    finally:
        with contextlib.suppress(OSError):  # an empty folder may stay
            for folder in reversed(made):
                folder.rmdir()


@contextlib.contextmanager
def holding(
    option: str, path: Path | None, hold: Callable[[Path], AbstractContextManager[None]] = hold_folder
) -> Iterator[None]:
    """Hold the folder, or file, of an option against other runs; None: nothing."""
    with contextlib.ExitStack() as held:
        if path is not None:
            with naming(folder=option, path=option):
                held.enter_context(hold(path))
        yield


def load_fingers(hand: str, fingers: str) -> tuple[Hand, Literal["auto"] | None]:
    """Load the hand of --hand with --fingers; return it, and "auto" where its sets of fingers are to be compared."""
    with naming(hand="--hand", name="--hand", fingers="--fingers"):
        return (load_hand(hand), "auto") if fingers == "auto" else (load_hand(hand, fingers), None)


def check_seed(seed: int) -> None:
    """Refuse a seed that no generator takes."""
    check_whole("--seed", seed, 0, 2**63 - 1)


def table_plane(
    cloud: PointCloud, view: ViewOptions, table: tuple[float, ...] | None, no_table: bool
) -> Plane | float | None:
    """Return the table, by default at the cloud's lowest point without outliers: a plane, or its height [m] along z.

    Of 66 scans on z = 0 seen by a noisy camera, the lowest point of all lies 30 mm below to 11 mm above it (29 of them
    more than 5 mm below). The lowest one that is no outlier lies 4 mm below to 14 mm above.

    Args:
        table: the height along the vertical, or a normal and the plane's distance from the origin along it.
    """
    if table is not None and no_table:
        raise BadArgument("--table", f"{' '.join(f'{x:g}' for x in table)} and --no-table", "one of the two")
    if no_table:
        return None
    if table is not None and len(table) not in (1, 4):
        raise BadArgument("--table", f"{len(table)} numbers", "a height, or four: a normal and its distance")
    numbers = (
        None if table is None else check_tensor("--table", torch.tensor(table, dtype=torch.float64), (len(table),))
    )
    if numbers is not None and len(numbers) == 4:
        length = torch.linalg.vector_norm(numbers[:3])
        if not bool(length > 0):
            raise BadArgument("--table", "a normal of length zero", "the direction that points up")
        return Plane(numbers[:3] / length, float(numbers[3] / length))
    up = view.vertical
    if numbers is None:
        seen = cloud.points[find_inliers(cloud.points.double())]
        height = float((seen[:, 2] if up is None else seen.double() @ up).min())
    else:
        height = float(numbers[0])
    return height if up is None else Plane(up, height)


def describe_table(table: Plane | float) -> str:
    """Say where the table is."""
    if isinstance(table, Plane):
        x, y, z = (0.0 + round(n, 3) for n in table.normal.tolist())
        return f"table at {table.offset:.3f} m along ({x:g}, {y:g}, {z:g})"
    return f"table at z = {table:.3f} m"
