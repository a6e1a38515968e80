"""The intrinsics of a depth camera in the forms of many drivers, and checks that they fit."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.lens import FIELDS, Lens, numbers_of, read_lens
from torchgrasp.foundation.checks import check_tensor
from torchgrasp.foundation.errors import BadArgument, CloudWarning
from torchgrasp.foundation.limits import SHOWN_LETTERS
from torchgrasp.foundation.told import warn_user

Matrix = Float[Tensor, "3 3"]
OPEN3D = "intrinsic_matrix"
MATRICES = ("k", "cam_k", "camera_matrix", OPEN3D, "cameraintrinsics", "cameramatrix", "data")
"""Names of a matrix of intrinsics, or of an object that holds it: of ROS, BOP, Open3D and Zivid."""
ATTRIBUTES = (
    *MATRICES,
    *("P", "p", "D", "d", "K", "fx", "fy", "cx", "cy", "ppx", "ppy"),
    *FIELDS,
    *("width", "height", "roi", "binning_x", "binning_y"),
)
"""Names of the attributes of an object that describes a camera."""
COUNTS = ("factor_depth", "depth_factor", "png_depth_scale", "depthmapfactor")
"""Names under which files state how many counts of the depth are a metre: of GraspNet, NICE-SLAM
and ORB-SLAM.
"""
SIDES = ("x_offset", "y_offset", "width", "height")
"""Names of the four numbers of ROS's region of interest [px]."""
SCALES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4)
"""Ratios of two resolutions of one camera that are usual."""
MODES = (
    *((320, 240), (424, 240), (480, 270), (512, 424), (640, 360), (640, 480), (640, 576)),
    *((848, 480), (960, 540), (960, 720), (1024, 768), (1280, 720), (1280, 960)),
    *((1920, 1080), (1920, 1440), (1944, 1200), (2048, 1536)),
)
"""Resolutions (width, height) [px] of depth cameras."""


@dataclasses.dataclass(frozen=True)
class IntrinsicsNumbers:
    """Bounds of the intrinsics that are read, and of what a camera may have."""

    most: int = 12
    """Greatest number of entries of a list of intrinsics: that of a 3 x 4 projection."""
    nested: int = 4
    """Greatest depth of nested objects at which a matrix is found; those of ROS and Zivid have
    two.
    """
    greatest: float = 1e9
    """Upper bound of a width, a height and a depth scale: no camera has greater ones."""
    widest: float = 1e6
    """Upper bound of the side of a region of interest [px], and of a binning."""
    shown: int = 8
    """Greatest number of names of a wrong object that an error shows."""
    shown_name: int = 20
    """Greatest number of letters of each name in an error."""
    focal: float = 0.15
    """Least focal length, as a share of the image's side. It means a view of 147 degrees; no camera
    has a wider one.
    """
    unequal: float = 0.05
    """Greatest difference of fx and fy, as a share of fy, of four numbers in the right order."""
    uneven: float = 0.12
    """Difference of fx and fy, as a share of fy, from which a warning is given. Pixels of old
    cameras differ by less, images that were resized to other proportions by more.
    """
    beside: float = 0.1
    """Greatest shift of the principal point from the image's middle, for four numbers in the right
    order. It is a share of the side.
    """
    farthest: float = 8.0
    """Greatest shift of the principal point of a crop from the crop's middle, as a share of the
    side. Beyond it, the point belongs to another image.
    """
    corner: float = 0.05
    """Greatest distance by which a crop may reach out of its camera's image, as a share of the
    side.
    """
    moved: float = 0.04
    """Least shift of a crop's corner, as a share of the side: a camera's principal point is off by
    less.
    """
    cropped: float = 0.03
    """Greatest shift of the principal point from the middle of a camera's image that was perhaps
    cropped. It is also the least shift from the middle of the crop. Both are shares of half the
    side.
    """
    centred: float = 0.05
    """Greatest shift of the principal point from the middle of an image whose size is guessed. It
    is a share of half the side.
    """
    scaled: float = 2.5
    """Ratio of the principal point's coordinates to those of the image's middle, or its inverse.
    From this ratio on, the same for both sides, the point belongs to an image of another scale. The
    point of a crop is nearer.
    """
    off: float = 0.16
    """Shift of the principal point from the middle, as a share of half the side. Beyond it another
    resolution is guessed: few cameras have more.
    """
    agree: float = 0.5
    """Greatest difference [px] between the numbers of ROS's matrices K and P that count as
    equal.
    """
    swapped: float = 0.05
    """Greatest shift of the principal point from the middle, as a share of the side. It counts with
    cx and cy as they are, and exchanged, to find exchanged ones.
    """
    same_ratio: float = 0.02
    """Greatest relative difference of two ratios of sides that count as equal."""


LIMITS = IntrinsicsNumbers()


class Written(NamedTuple):
    """Intrinsics as a driver or a file writes them.

    Attributes:
        table: (fx, fy, cx, cy) or a matrix [pixels], of any type of array.
        size: width and height of the image [pixels].
        scale: metres of one count of the depth.
        window: x, y, width and height of ROS's region of interest [pixels], then the binning in x
            and y. Each is 0 if not set.
        lens: distortion of the image; None for a pinhole's.
    """

    table: Any
    size: list[float] | None = None
    scale: float | None = None
    window: Sequence[float] = ()
    lens: Lens | None = None


def parse_intrinsics(
    value: object,
) -> tuple[Matrix, list[float] | None, float | None, Lens | None]:
    """Return the matrix (3, 3) [pixels] of a camera's intrinsics, and what else describes the
    camera.

    `value` has any form that `cloud_from_depth` takes: a matrix, four numbers, a dict or a driver's
    object. Second is the [width, height] of the image [pixels]. Third are the metres of one count
    of the depth, and fourth is the distortion. Each is None if it is not stated. Raises
    `BadArgument` for anything else.
    """
    table, size, scale, window, lens = _read_written(value)
    k = as_tensor("intrinsics", table)
    allowed = "(fx, fy, cx, cy), or a 3 x 3 matrix"
    # a copy: programs scale one matrix for images of several sizes
    k = k if k.is_complex() else k.to(torch.float64, copy=True)
    if k.ndim == 1 and len(k) in (3 * 3, 3 * 4):
        k = k.reshape(3, -1)
    if k.shape in ((4,), (6,)):
        fx, fy, cx, cy = k[:4].tolist()
        size = k[4:].tolist() or size
        k = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    if k.shape not in ((3, 3), (3, 4), (4, 4)):
        raise BadArgument("intrinsics", f"shape {tuple(k.shape)}", allowed)
    check_tensor("intrinsics", k, tuple(k.shape))
    if k[:3, 3:].any():
        found = f"a fourth column {k[:3, 3].tolist()}"
        raise BadArgument("intrinsics", found, f"{allowed}: K of this camera")

    k = k[:3, :3]
    positive = bool(k[0, 0] > 0) and bool(k[1, 1] > 0)
    skewed = bool(k[0, 1] != 0) or bool(k[1, 0] != 0)
    if not positive or skewed or k[2].tolist() != [0, 0, 1]:
        turned = bool(k[2, :2].any()) and not bool(k[:2, 2].any())
        allowed = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0"
        raise BadArgument("intrinsics", k.tolist(), allowed + ", the transpose" * turned)
    if any(window):
        k, size = _cut(k, size, window)
    return k, size, scale, lens


def _cut(
    k: Matrix, size: list[float] | None, window: Sequence[float]
) -> tuple[Matrix, list[float] | None]:
    """Return the intrinsics and the size of ROS's region of interest; those given are of the whole
    sensor.
    """
    corner, sides, bins = k.new_tensor(window).reshape(3, 2)
    bins = bins.clamp_min(1)
    centre = k[:2, 2:] - corner[:, None]
    binned = torch.cat([k[:2, :2], centre], 1) / bins[:, None]
    # A side of 0 is that of the whole sensor, which may be unknown.
    whole = torch.tensor(size or [0.0, 0.0]).to(sides)
    sides = torch.where(sides > 0, sides, whole) / bins
    stated = sides.floor().tolist() if sides.all() else size
    return torch.cat([binned, k[2:]]), stated


def _read_written(value: object) -> Written:
    """Return the intrinsics in an array, a list, a mapping or an object."""
    if isinstance(value, Tensor | np.ndarray | Sequence) and not isinstance(value, str):
        return Written(value)
    named, key, table = _find_matrix(value)
    if not isinstance(table, Tensor | np.ndarray) and not _is_table(table):
        names = [str(name)[: LIMITS.shown_name] for name in list(named)[: LIMITS.shown]]
        found = f"a {type(value).__name__} of {', '.join(names) or 'nothing'}"
        allowed = "fx, fy, cx and cy, or a matrix K; of a file of many images, the entry of this"
        raise BadArgument("intrinsics", found, f"{allowed} image")
    lens = read_lens(named)
    table, lens = _choose_of_ros(named, table, lens)
    by_column = key == OPEN3D and isinstance(table, list) and len(table) == 9
    if by_column and table[2] == table[5] == 0:
        table = [table[i::3] for i in range(3)]

    width = named.get("width", named.get("image_width"))
    height = named.get("height", named.get("image_height"))
    scale = named.get("depth_scale")
    counts = next((named[name] for name in COUNTS if named.get(name) is not None), None)
    stated = {"width": width, "height": height, "depth_scale": scale, "depth factor": counts}
    for name, x in stated.items():
        if x is not None and (not _is_table([x]) or not 0 < x < LIMITS.greatest):
            found = f"{name} = {str(x)[:SHOWN_LETTERS]!r}"
            raise BadArgument("intrinsics", found, f"a positive {name}")
    # Open3D states the counts of a metre, RealSense metres of a count, BOP millimetres of a count.
    if scale is not None and key == OPEN3D:
        scale = 1 / scale
    elif scale is not None and "ppx" not in named:
        scale = scale / 1000.0
    elif scale is None and counts is not None:
        scale = 1 / counts
    size = None if width is None or height is None else [float(width), float(height)]
    return Written(table, size, scale, _read_window(named), lens)


def _choose_of_ros(
    named: Mapping[str, Any], table: Any, lens: Lens | None
) -> tuple[Any, Lens | None]:
    """Return the matrix of ROS's CameraInfo that holds for a depth image, and its distortion.

    They are K and the `lens`, or P alone if K is not set. Raises `BadArgument` if the raw and the
    rectified image differ, as only one of them is meant.
    """
    rectified = named.get("p", named.get("projection_matrix"))
    rectified = rectified.get("data") if isinstance(rectified, Mapping) else rectified
    p = numbers_of(rectified)
    k = numbers_of(table)
    given = len(p) == 3 * 4 and p[0] > 0
    if given and k and not any(k):
        return rectified, None
    differ = False
    if given and len(k) == 3 * 3:
        rows = [*p[:3], *p[4:7], *p[8:11]]
        differ = max(abs(x - y) for x, y in zip(k, rows, strict=True)) > LIMITS.agree
    if differ or (lens is not None and given):
        found = f"a K beside another P{', and distortion D' * (lens is not None)}"
        if not differ:
            found = "a K with distortion D beside P"
        raise BadArgument(
            "intrinsics", found, "of a rectified image, P alone; of a raw one, K and D"
        )
    return table, lens


def _find_matrix(value: object) -> tuple[dict[str, Any], str, Any]:
    """Return the named values of a description of a camera, the name of its matrix, and the matrix.

    The name is "" for four numbers instead of a matrix.
    """
    inner: Any = value
    if not isinstance(value, Mapping):
        inner = {name: getattr(value, name) for name in ATTRIBUTES if hasattr(value, name)}
    named = dict[str, Any]()
    key = ""
    # ROS and Zivid write a matrix as an object.
    for _ in range(LIMITS.nested):
        named |= {str(name).lower(): x for name, x in inner.items()}
        key = next((name for name in MATRICES if name in named), "")
        inner = named.pop(key, None)
        if not isinstance(inner, Mapping):
            break
    if not key and "p" in named and named.get("fx") is None:
        key = "p"
        inner = named.pop("p")
    if not key:
        cx = named.get("cx", named.get("ppx"))
        cy = named.get("cy", named.get("ppy"))
        inner = [named.get("fx"), named.get("fy"), cx, cy]
    return named, key, inner


def _read_window(named: Mapping[str, Any]) -> list[float]:
    """Return x, y, width and height of ROS's region of interest [px], and the binning in x and y.
    Each is 0 if not set.
    """
    roi = named.get("roi", {})
    region = roi if isinstance(roi, Mapping) else {side: getattr(roi, side, 0) for side in SIDES}
    found = [region.get(side, 0) for side in SIDES]
    found += [named.get("binning_x", 0), named.get("binning_y", 0)]
    if not _is_table(found) or not all(0 <= number < LIMITS.widest for number in found):
        shown = f"roi and binning {str(found)[:SHOWN_LETTERS]}"
        raise BadArgument("intrinsics", shown, "numbers of pixels >= 0")
    return [float(number) for number in found]


def _is_table(value: object) -> bool:
    """Return whether a value from a file is a short list of numbers, or of rows of at most 4."""
    if not isinstance(value, list | tuple) or not 0 < len(value) <= LIMITS.most:
        return False
    rows = [row if isinstance(row, list | tuple) else [row] for row in value]
    if any(len(row) > 4 for row in rows):
        return False
    return all(isinstance(x, Real) and not isinstance(x, bool) for row in rows for x in row)


def check_intrinsics(k: Matrix, stated: list[float] | None, size: Sequence[int]) -> None:
    """Raise `BadArgument` for intrinsics that no camera has, or that do not belong to an image of
    this size.

    No camera has a field of view above 147 degrees. Numbers in a wrong order, such as cx, cy, fx,
    fy, are refused, too. Intrinsics of another image have a principal point more than 8 sides from
    the middle, or another resolution. The resolution is right if `stated` is the image's size, or
    that of a larger image around it. Without `stated`, the principal point shows the resolution. A
    `CloudWarning` is given if fx and fy differ by over 12 % (`LIMITS.uneven`).

    Args:
        k: matrix of the intrinsics [pixels].
        stated: [width, height] [pixels] of the image to which the intrinsics belong, as their
            source states it; None if it does not.
        size: (h, w) [pixels] of the image, which may be a crop.
    """
    height, width = size
    (fx, _, cx), (_, fy, cy) = k[:2].tolist()
    if min(fx / width, fy / height) < LIMITS.focal:
        angle = math.degrees(2 * math.atan(max(width / fx, height / fy) / 2))
        found = f"fx = {fx:.4g} and fy = {fy:.4g}, a view of {angle:.0f} degrees"
        fix = "multiply normalised ones by width and height, divide millimetres by the size of a"
        raise BadArgument("intrinsics", found, f"focal lengths in pixels: {fix} pixel")

    def shift(cx: float, cy: float) -> float:
        return max(abs(cx / width - 0.5), abs(cy / height - 0.5))

    def fits(fx: float, fy: float, cx: float, cy: float) -> bool:
        return abs(fx / fy - 1) < LIMITS.unequal and shift(cx, cy) < LIMITS.beside

    orders = {"fx, cx, fy, cy": (fx, cx, fy, cy), "cx, cy, fx, fy": (cx, cy, fx, fy)}
    for order, meant in orders.items():
        if not fits(fx, fy, cx, cy) and min(meant) > 0 and fits(*meant):
            raise BadArgument("intrinsics", f"the order {order}", "the order fx, fy, cx, cy")
    if shift(cx, cy) > LIMITS.farthest:
        found = f"a principal point ({cx:.4g}, {cy:.4g}) px in an image of {width} x {height}"
        raise BadArgument("intrinsics", found, "a crop nearer to it")
    _check_size(k, stated, width, height)
    straight = fits(fx, fy, cx, cy) and shift(cx, cy) <= LIMITS.swapped
    if not straight and fits(fx, fy, cy, cx) and shift(cy, cx) <= LIMITS.swapped:
        found = f"a principal point ({cx:.4g}, {cy:.4g}) px in an image of {width} x {height}"
        raise BadArgument("intrinsics", found, "cx of the column before cy of the row")
    if abs(fx / fy - 1) > LIMITS.uneven:
        found = (
            f"intrinsics: fx is {fx / fy:.3g} times fy, as of an image that was resized unevenly"
        )
        warn_user(
            CloudWarning, f"{found}; if it was cropped instead, give one focal length for both"
        )


def _check_size(k: Matrix, stated: list[float] | None, width: int, height: int) -> None:
    """Raise `BadArgument` if intrinsics belong to another resolution than the size of an image."""
    shown = f"an image of {width} x {height}"
    image = k.new_tensor([width, height])
    centre = 2 * k[:2, 2]
    if stated is not None:
        own = k.new_tensor(stated)
        corner = (own - centre) / 2  # of the crop, seen from the middle
        low = -LIMITS.corner * own
        high = (1 + LIMITS.corner) * own - image
        inside = bool(((corner > low) & (corner < high)).all())
        if inside and (corner.abs() > LIMITS.moved * own).any():
            return
        if torch.equal(own, image):
            return
        found = f"those of an image of {stated[0]:g} x {stated[1]:g} px for {shown}"
    else:
        # The principal point tells the size of the image, roughly.
        modes = map(k.new_tensor, MODES)
        sizes = [image * scale for scale in SCALES]
        sizes += [mode for mode in modes if not torch.equal(mode, image)]
        scale = centre / image
        if float(scale.min()) > LIMITS.scaled or float(scale.max()) < 1 / LIMITS.scaled:
            sizes.append(image * scale.mean())
        near = [m for m in sizes if ((centre / m - 1).abs() < LIMITS.centred).all()]
        if not near or float((centre / image - 1).abs().max()) < LIMITS.off:
            _tell_crop(image, centre)
            return
        own = near[0]
        found = f"a principal point ({k[0, 2]:.1f}, {k[1, 2]:.1f}) px in {shown}"

    fix = ""
    ratio = image / own
    if abs(float(ratio[0] / ratio[1]) - 1) < LIMITS.same_ratio:
        fix = f"all four times {float(ratio[0]):.4g}; "
    elif torch.equal(own, image.flip(0)):
        fix = "the transposed image, (height, width); "
    crop = (
        "of a crop, cx and cy less its corner, and (fx, fy, cx, cy, width, height) with the size "
        "of the crop"
    )
    raise BadArgument("intrinsics", found, f"intrinsics of the same resolution: {fix}{crop}")


def _tell_crop(image: Float[Tensor, "2"], centre: Float[Tensor, "2"]) -> None:
    """Warn (`CloudWarning`) of a size that no camera has, if the principal point is the middle of a
    larger size that one has.

    `image` is the (width, height) and `centre` twice the principal point [pixels].
    """
    modes = [image.new_tensor(mode) for mode in MODES]
    own = float((centre / image - 1).abs().max())
    if own < LIMITS.cropped or any(torch.equal(mode, image) for mode in modes):
        return
    whole = [mode for mode in modes if (mode >= image).all()]
    whole = [mode for mode in whole if float((centre / mode - 1).abs().max()) < LIMITS.cropped]
    if whole:
        size, full = (" x ".join(f"{side:g}" for side in sides) for sides in (image, whole[0]))
        found = f"intrinsics: a principal point in the middle of {full} px, and an image of {size}"
        fix = "if the image is a crop, take its corner from cx and cy, and give width and height"
        warn_user(CloudWarning, f"{found}: {fix}")


def as_tensor(name: str, value: Any) -> Tensor:
    """Return an array of numbers as a tensor.

    Raises `BadArgument`, which calls the argument `name`, for anything else.
    """
    if isinstance(value, Tensor):
        return value
    try:
        array = np.array(value)
        # Some files are big-endian.
        return torch.from_numpy(array.astype(array.dtype.newbyteorder("=")))
    except (TypeError, ValueError) as error:  # text, objects, rows of different length
        raise BadArgument(name, describe_array(value), "an array of numbers") from error


def describe_array(value: object) -> str:
    """Return the type, the shape and the dtype of an array as text."""
    shape = getattr(value, "shape", ())
    dtype = getattr(value, "dtype", "no dtype")
    return f"{type(value).__name__} of shape {tuple(shape)}, {dtype}"
