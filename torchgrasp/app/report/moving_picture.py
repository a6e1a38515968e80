"""A simulated closing as a moving picture: a GIF, or an MP4 with the extra `film`."""

import dataclasses
import importlib
import io
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import UInt8

from torchgrasp.app.report.closing_pictures import draw_ticks, finite_ticks
from torchgrasp.app.report.raster import Direction
from torchgrasp.app.report.stills import facing
from torchgrasp.control.reference import check_single
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, MissingExtra, OutputError, one_line
from torchgrasp.foundation.lazy import Image, trimesh
from torchgrasp.foundation.rules import Range, check_suffix
from torchgrasp.geometry.frames import inverse, real
from torchgrasp.geometry.plane import as_plane, move, upright_frame, upright_table
from torchgrasp.hand.hand import Hand
from torchgrasp.values.closing import ClosureResult
from torchgrasp.values.planning import Grasps

KINDS = (".gif", ".mp4")
Rate = Annotated[int, Range(1, 50)]  # pictures each second: a GIF counts hundredths of a second


@dataclasses.dataclass(frozen=True)
class MovieLayout:
    """Sizes and limits of a moving picture."""

    size: tuple[int, int] = (560, 448)  # width and height [pixels]; even, as H.264 needs
    longest: float = 60.0  # longest closing that is filmed [s]
    colors: int = 256  # greatest number of colours of a GIF
    samples: int = 12  # number of pictures from which the colours of a GIF are taken
    tick: float = 0.01  # unit of the times in a GIF [s]
    quality: int = 20  # quality of H.264 (its "crf"): a lower number gives a larger, sharper file
    most_error: int = 200  # greatest number of characters of ffmpeg's own message in an error


MOVIE = MovieLayout()


@checked
def write_film(
    path: Path | str,
    hand: Hand,
    grasp: Grasps,
    closure: ClosureResult,
    mesh: "trimesh.Trimesh",
    direction: Direction | None = None,
    rate: Rate = 15,
    observer: Callable[[int, int], Any] | None = None,
) -> Path:
    """Write a simulated closing as a moving picture in real time, atomically; return the path.

    It shows the approach, the closing and the lift, from one fixed camera.

    Args:
        path: the file to write: .gif or .mp4. An .mp4 needs the extra `film`, or `ffmpeg` on the
            search path.
        hand: the hand of the grasp.
        grasp: a single grasp.
        closure: the simulated closing of this grasp, from `close_hand`.
        mesh: the object's mesh [m] in the frame of the grasp, that of the planned cloud.
        direction: direction (x, y, z) from the object to the camera, of any length. Axis z is up,
            along the normal of the grasp's table. Axis x points from the object's vertical centre
            line to its farthest point, such as a handle. Without a table, the axes are those of the
            grasp's frame. None means a side from which all fingers are seen. The camera's elevation
            is kept between about 15 and 40 degrees.
        rate: pictures in each second, 1 to 50.
        observer: function that is called after each picture, with the number of pictures done and
            the number of all pictures.

    Raises:
        BadArgument: the file is of another kind, there is not exactly one grasp, or the closing is
            longer than a minute.
        MissingExtra: ffmpeg is missing for an .mp4.
        OutputError: the file cannot be written.

    >>> write_film("jug.gif", hand, grasp, closure, jug.mesh)  # doctest: +SKIP
    """
    place = Path(path)
    kind = place.suffix.lower()
    check_kind(place)
    check_single(grasp)
    seconds = float(closure.time[-1] - closure.time[0])
    if not seconds <= MOVIE.longest:
        raise BadArgument("closure", f"{seconds:.0f} s", f"at most {MOVIE.longest:g} s")
    ticks = _ticks(closure, rate)
    pictures = []
    for picture in _draw(hand, grasp, closure, mesh, direction, ticks):
        pictures.append(picture)
        if observer is not None:
            observer(len(pictures), len(ticks))
    data = _encode_gif(pictures, rate) if kind == ".gif" else _encode_mp4(pictures, rate, place)
    return write_file(place, data)


def check_kind(path: Path) -> None:
    """Raise `BadArgument` for a path that ends neither in .gif nor in .mp4. For .mp4, raise
    `MissingExtra` if ffmpeg is not installed.
    """
    check_suffix("path", path, *KINDS)
    if path.suffix.lower() == ".mp4":
        find_ffmpeg()


def find_ffmpeg() -> str:
    """Return the path of ffmpeg: that of the package imageio-ffmpeg, else of the search path.

    Raises `MissingExtra` if there is none.
    """
    try:
        return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        found = shutil.which("ffmpeg")
    if found is None:
        raise MissingExtra("imageio-ffmpeg", "film")
    return found


def _ticks(closure: ClosureResult, rate: int) -> list[int]:
    """Return the control ticks of the pictures; those of a diverged simulation are left out."""
    finite = finite_ticks(closure)
    times = closure.time[finite].double()
    first = float(times[0])
    wanted = first + torch.arange(int((float(times[-1]) - first) * rate) + 1) / rate
    # the last picture shows the end
    wanted = torch.cat([wanted.double(), times[-1:]])
    nearest = torch.searchsorted(times, wanted).clamp_max(len(times) - 1)
    ticks = finite[nearest].tolist()
    return ticks[:-1] if len(ticks) > 1 and ticks[-1] == ticks[-2] else ticks


def _draw(
    hand: Hand,
    grasp: Grasps,
    closure: ClosureResult,
    mesh: "trimesh.Trimesh",
    direction: Direction | None,
    ticks: list[int],
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Return the pictures at some ticks."""
    obj_from_level = torch.eye(4, dtype=torch.float64)
    if grasp.table is not None:
        obj_from_level = upright_frame(real(mesh.triangles.reshape(-1, 3)), None, grasp.table)
    level_from_obj = inverse(obj_from_level)
    level = dataclasses.replace(
        closure,
        object_pose=level_from_obj @ closure.object_pose.double(),
        hand_pose=level_from_obj @ closure.hand_pose.double(),
    )
    if direction is None:
        direction = facing(move(grasp.to(torch.float64), level_from_obj))
    table = as_plane(upright_table(grasp.table, obj_from_level))
    # the hand is seen at both ends of its way
    framed = 0, len(ticks) // 2, -1
    return draw_ticks(mesh, hand, level, ticks, framed, direction, table, MOVIE.size)


def _encode_gif(pictures: list[UInt8[np.ndarray, "h w 3"]], rate: int) -> bytes:
    """Return the bytes of a GIF that repeats for ever; all pictures share their colours."""
    sampled = pictures[:: max(1, len(pictures) // MOVIE.samples)]
    palette = Image.fromarray(np.concatenate(sampled)).quantize(MOVIE.colors)
    plain = Image.Dither.NONE  # dots that flicker would look worse than bands
    frames = [Image.fromarray(p).quantize(palette=palette, dither=plain) for p in pictures]
    # each time is rounded to hundredths of a second, so that no error grows
    ends = np.round((np.arange(len(frames)) + 1) / rate / MOVIE.tick)
    spans = np.diff(ends, prepend=0.0) * MOVIE.tick * 1000
    buffer = io.BytesIO()
    first, *others = frames
    first.save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=[round(span) for span in spans],
        loop=0,
    )
    return buffer.getvalue()


def _encode_mp4(pictures: list[UInt8[np.ndarray, "h w 3"]], rate: int, path: Path) -> bytes:
    """Return the bytes of an MP4 with H.264, which every browser plays."""
    height, width, _ = pictures[0].shape
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.mp4"
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        coded = ["-c:v", "libx264", "-crf", str(MOVIE.quality), "-pix_fmt", "yuv420p"]
        words = [find_ffmpeg(), "-v", "error", *source, "-r", str(rate), "-i", "-", *coded]
        # the same pictures give the same bytes, and a page can begin to play early
        words += ["-fflags", "+bitexact", "-movflags", "+faststart", str(file)]
        raw = b"".join(picture.tobytes() for picture in pictures)
        done = subprocess.run(words, input=raw, capture_output=True, check=False)
        if done.returncode != 0 or not file.is_file():
            said = one_line(done.stderr.decode(errors="replace"))[: MOVIE.most_error]
            wanted = "an ffmpeg with libx264, as of the extra film"
            raise OutputError("path", f"{path}, which ffmpeg cannot encode ({said})", wanted)
        return file.read_bytes()
