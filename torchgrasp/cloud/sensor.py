"""The noise of depth cameras: added to exact images, estimated from real images, and reduced by a
median of frames.
"""

import dataclasses
import math
import statistics
import types
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.intrinsics import Matrix, as_tensor
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import ndimage, optimize
from torchgrasp.geometry.plane import Plane

Image = Float[Tensor, "h w"]
SensorName = Literal["realsense", "realsense_cloud", "kinect_v1", "azure", "zivid"]
"""Depth cameras with a model of their noise."""


@dataclasses.dataclass(frozen=True)
class FaultNumbers:
    """Parameters of a depth camera's errors other than random noise: at rims and in corners."""

    background: float = 100.0
    """Depth [m] that is assumed for a pixel in which nothing is measured."""
    width: int = 5
    """Side [px] of the square about a pixel that is searched for another surface. A pixel with one,
    so within two pixels, is at a rim.
    """
    jump: float = 0.010
    """Least difference in depth [m] between the two surfaces at a rim. A smaller one is not a jump.
    """
    corner: float = 8.0
    """Standard deviation [px] of the Gaussian blur that gives the mean depth around a pixel. Light
    from these surroundings reaches a corner.
    """
    deepest: float = 0.01
    """Greatest depth [m] of a pixel behind the mean depth around it at which it counts as in a
    corner.
    """
    beside: int = 3
    """Side [px] of the square about a pixel in which a jump of depth is sought. A pixel with one is
    at the border of the strip that is lost along rims (`SensorNoise.worn`).
    """
    fine: float = 0.5
    """Standard deviation [px] of the Gaussian blur of the noise `SensorNoise.fine`. With it, the
    noise of adjacent pixels is similar, and that of pixels farther apart is nearly independent.
    """
    spread: float = 0.2
    """Factor of the steps of diffusion that blur the depth image (`SensorNoise.smoothing`). A step
    adds this share of the depth differences to the four neighbours to a pixel's depth. Steps are
    stable below a quarter. Each adds twice this share to the variance [px^2] of the blur.
    """


@dataclasses.dataclass(frozen=True)
class EstimateNumbers:
    """Parameters of the estimate of a depth camera's noise from a table, or from depth errors."""

    patch: int = 21
    """Side [px] of the square patches whose mean error is the camera's bias."""
    least: int = 1000
    """Least number of pixels that show the noise of a table."""
    near: float = 0.02
    """Distance [m] of a pixel from the table beyond which it does not count."""
    full: float = 0.9
    """Least share of the pixels of a patch that are on the table. Other patches are at the feet of
    objects.
    """
    least_share: float = 1e-9
    """Least share of a patch that is a divisor, so that the mean of an empty patch is finite."""
    errors: int = 100
    """Least number of depth errors to which a model of the noise is fitted."""
    groups: int = 8
    """Number of groups of similar depths to whose standard deviations the model is fitted."""
    gaussian: float = 1.4826
    """Ratio of the standard deviation to the median absolute deviation of Gaussian errors."""


@dataclasses.dataclass(frozen=True)
class StillNumbers:
    """Bounds by which frames show that camera and scene stood still."""

    off: float = 0.02
    """Deviation of a pixel from the median of the frames, as a share of its depth, beyond which it
    differs.
    """
    share: float = 0.05
    """Greatest share of pixels that differ, if the camera stood still. Noise and flying pixels
    change fewer.
    """
    side: int = 8
    """Side [px] of the patches whose median depths are compared, too: these have less noise."""
    patch_off: float = 0.015
    """Deviation of the median depth of a patch, as a share of its depth, beyond which it differs.
    """
    patch_share: float = 0.01
    """Greatest share of patches that differ, if the camera stood still: rims of objects, and bias.
    """


FAULTS = FaultNumbers()
ESTIMATE = EstimateNumbers()
STILL = StillNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class SensorNoise(Value):
    """A model of a depth camera's noise, for `partial_view`: random noise, rounding, bias and
    faults.

    The faults are flying and missing pixels at rims, missing pixels at grazing angles, and errors
    in corners. A rim is an outline at which the depth jumps. A stereo camera measures the disparity
    f b / depth [px], with focal length f [px] and baseline b [m].

    Args:
        base: f b [px m] of a stereo camera; 0 means a time-of-flight camera.
        disparity: standard deviation of the disparity [px]; only with a `base`.
        step: resolution of the disparity [px], to which it is rounded; 0 means no rounding. Only
            with a `base`.
        floor: the part of the depth's standard deviation [m] that is the same at any depth.
            `partial_view` draws it only without a `base`.
        growth: the other part [1/m], which is multiplied by the squared depth; only without a
            `base`. The squares of both parts add up (`sigma`).
        grain: standard deviation [px] of the Gaussian blur that makes neighbouring pixels have
            similar noise; 0 means independent pixels.
        bias: standard deviation [m] of the smooth bias of the depth.
        bias_width: standard deviation [px] of the Gaussian blur that makes the bias smooth.
        shadow: whether pixels are missing that the stereo camera's second lens does not see.
        flying: share [0 to 1] of the pixels at rims that are flying pixels: their depth is too
            great.
        flight: mean error [m] of the depth of flying pixels.
        lost_rim: share [0 to 1] of the pixels at rims that have no depth.
        lost: share [0 to 1] of all pixels that are missing at random.
        grazing: angles [deg] between ray and surface normal at which pixels begin to be missing,
            and at which all are missing.
        multipath: error of a time-of-flight camera in a corner (no unit). The measured depth is too
            great by this factor times the corner's depth behind its surroundings.
        fine: standard deviation [px] of a second noise of the disparity, in patches of about a
            pixel; only with a `base`.
        smoothing: standard deviation [px] of the blur by the matching window, within each surface:
            it rounds edges.
        worn: mean width [px] of the strip that is lost along rims. Each view draws its own width,
            up to twice the mean. The width varies along the rim, over about `hole_width`.
        holes: share [0 to 1] of pixels that are lost in patches, as on dark and shiny parts.
        hole_width: width [px] of these patches.
        crop: height [m] above the lowest point, along z of the frame of `partial_view`. Points
            below it are missing, as after a rough removal of the table. Depth images are not
            cropped.
        misplaced: standard deviation [m] along each axis of an error of the camera's calibration.
            It moves the points of `partial_view` with their camera. Depth images do not move.

    >>> float(SENSORS["kinect_v1"].sigma(torch.tensor(2.0))) < 0.007
    True
    """

    base: float = 0.0
    disparity: float = 0.0
    step: float = 0.0
    floor: float = 0.0
    growth: float = 0.0
    grain: float = 0.0
    bias: float = 0.0008
    bias_width: float = 12.0
    shadow: bool = False
    flying: float = 0.25
    flight: float = 0.008
    lost_rim: float = 0.35
    lost: float = 0.01
    grazing: tuple[float, float] = (72.5, 87.0)
    multipath: float = 0.0
    fine: float = 0.0
    smoothing: float = 0.0
    worn: float = 0.0
    holes: float = 0.0
    hole_width: float = 5.0
    crop: float = 0.0
    misplaced: float = 0.0

    @checked
    def sigma(self, depth: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return the standard deviation (*b,) [m] of the random noise of the depth, at each depth.

        It contains neither the bias nor the rounding of the disparity. b stands for any batch axes.

        Args:
            depth: depths (*b,) [m].
        """
        disparity = math.hypot(self.disparity, self.fine)
        growth = disparity / self.base if self.base else self.growth
        return torch.sqrt(self.floor**2 + (growth * depth * depth) ** 2)


ACTIVE_STEREO = SensorNoise(base=616.0 * 0.055, disparity=0.12, step=1 / 32)
"""Noise of an active stereo camera with a baseline of 55 mm and independent pixels; `noise=True`
selects it.
"""
SENSORS: Mapping[SensorName, SensorNoise] = types.MappingProxyType(
    {
        # Intel's tuning guide of the D400: about 0.08 px of subpixel noise, 50 mm baseline; patches
        # as in public frames.
        "realsense": SensorNoise(
            30.8, 0.08, 1 / 32, grain=5.0, bias=0.0015, bias_width=18.0, shadow=True
        ),
        # The same as clouds of things come from other people. It is fitted to what the clouds of 7
        # things by a D435 and a D455 show by themselves
        # (`scripts/bench.py shape --only residuals`).
        "realsense_cloud": SensorNoise(
            30.8,
            0.08,
            1 / 32,
            grain=4.0,
            bias=0.003,
            bias_width=14.0,
            shadow=True,
            flying=0.0,
            lost_rim=0.0,
            lost=0.0,
            grazing=(55.0, 75.0),
            fine=0.035,
            smoothing=2.5,
            worn=1.2,
            holes=0.03,
            hole_width=5.0,
            crop=0.004,
            misplaced=0.0015,
        ),
        # Khoshelham and Oude Elberink 2012: 0.00143 z^2 in all, steps of 1/8 px; 580 px and 75 mm.
        "kinect_v1": SensorNoise(
            43.5, 0.05, 1 / 8, grain=2.0, bias=0.0014, bias_width=18.0, shadow=True
        ),
        # Toelgyessy et al. 2021: below 17 mm and 11 mm of bias up to 3.5 m. Also flying pixels and
        # multipath of time of flight.
        "azure": SensorNoise(
            floor=0.001, growth=0.0005, bias=0.002, bias_width=30.0, flying=0.6, multipath=0.3
        ),
        # Zivid's data sheet of the Two M70: point precision 0.055 mm at 0.7 m.
        "zivid": SensorNoise(
            growth=0.00011, bias=0.0001, bias_width=30.0, flying=0.05, lost_rim=0.5, lost=0.02
        ),
    }
)
"""Noise of known cameras, by name."""


def find_sensor(noise: bool | SensorName | SensorNoise) -> SensorNoise | None:
    """Return the model of a camera's noise, by the camera's name; None for no noise.

    `noise` is a name: "realsense", "realsense_cloud", "kinect_v1", "azure" or "zivid". True means
    the noise of an active stereo camera, and False no noise. A model is returned itself.
    """
    if isinstance(noise, bool):
        return ACTIVE_STEREO if noise else None
    return SENSORS[noise] if isinstance(noise, str) else noise


def add_noise(
    depth: Image, cosine: Image, generator: torch.Generator, sensor: SensorNoise = ACTIVE_STEREO
) -> Image:
    """Return a depth image (h, w) [m] with a camera's noise; 0 where nothing is measured.

    `depth` is the exact image [m], 0 where no surface is. `cosine` (h, w) is the absolute cosine
    between each ray and the surface normal. `sensor` is the model of the noise, which `generator`
    draws.
    """
    normal = partial(torch.randn, depth.shape, generator=generator, dtype=torch.float64)
    uniform = partial(torch.rand, depth.shape, generator=generator, dtype=torch.float64)

    def patches(std: float, width: float) -> Tensor:
        field = torch.from_numpy(ndimage.gaussian_filter(normal().numpy(), width))
        return std * field / field.std()

    measured = depth > 0
    own = patches(1.0, sensor.grain) if sensor.grain else normal()
    noisy = torch.where(measured, depth, 1.0)
    if sensor.smoothing:
        noisy = _smooth(noisy, measured, sensor.smoothing)
    if sensor.base:
        disparity = sensor.base / noisy + sensor.disparity * own
        if sensor.fine:
            disparity = disparity + patches(sensor.fine, FAULTS.fine)
        if sensor.step:
            disparity = torch.round(disparity / sensor.step) * sensor.step
        noisy = sensor.base / disparity.clamp_min(sensor.step)
    else:
        noisy = noisy + sensor.sigma(noisy) * own
    noisy = noisy + patches(sensor.bias, sensor.bias_width)
    # Other surfaces, and the background, next to a pixel make it a rim.
    full = torch.where(measured, depth, FAULTS.background).numpy()
    far = torch.from_numpy(ndimage.maximum_filter(full, FAULTS.width))
    near = torch.from_numpy(ndimage.minimum_filter(full, FAULTS.width))
    rim = (far - depth > FAULTS.jump) | (depth - near > FAULTS.jump)
    flies = rim & (uniform() < sensor.flying)
    noisy = noisy + torch.where(flies, -sensor.flight * torch.log1p(-uniform()), 0.0)
    # Light by way of the walls of a corner takes longer.
    if sensor.multipath:
        around = torch.from_numpy(ndimage.gaussian_filter(depth.numpy(), FAULTS.corner))
        excess = (depth - around).clamp_min(0.0)
        noisy = noisy + sensor.multipath * torch.where(excess < FAULTS.deepest, excess, 0.0)
    # Pixels fade at grazing angles, and behind what hides them from the second eye.
    angle = torch.rad2deg(torch.arccos(cosine.clamp(0.0, 1.0)))
    low, high = sensor.grazing
    lost = (rim & (uniform() < sensor.lost_rim)) | (uniform() < sensor.lost)
    lost = lost | (uniform() < (angle - low) / (high - low))
    if sensor.worn:
        edge = (full - ndimage.minimum_filter(full, FAULTS.beside) > FAULTS.jump) | (
            ndimage.maximum_filter(full, FAULTS.beside) - full > FAULTS.jump
        )
        # things differ by their material: from none to twice the mean
        mean = 2.0 * sensor.worn * torch.rand((), generator=generator, dtype=torch.float64)
        width = mean * (1.0 + patches(1.0, sensor.hole_width))
        if edge.any():
            inward = torch.from_numpy(np.asarray(ndimage.distance_transform_edt(~edge)))
            lost = lost | (inward < width)
    if sensor.holes:
        most = statistics.NormalDist().inv_cdf(1.0 - sensor.holes)
        lost = lost | (patches(1.0, sensor.hole_width) > most)
    if sensor.shadow:
        column = torch.arange(depth.shape[1], dtype=torch.float64)
        # column in the other eye's image
        second = column - torch.where(measured, sensor.base / depth, 0.0)
        lost = lost | (second.flip(1).cummin(1).values.flip(1) < second)
    return torch.where(measured & ~lost, noisy, 0.0)


def _smooth(depth: Image, measured: Bool[Tensor, "h w"], width: float) -> Image:
    """Return a depth image blurred by `width` [px] within each surface. It is not blurred across a
    jump or the border of what is measured.
    """
    steps = max(1, round(width**2 / (2 * FAULTS.spread)))
    # a pixel and its neighbour below, or to the right, on one surface
    joined = [
        measured.narrow(axis, 1, depth.shape[axis] - 1)
        & measured.narrow(axis, 0, depth.shape[axis] - 1)
        & (depth.diff(dim=axis).abs() < FAULTS.jump)
        for axis in (0, 1)
    ]
    for _ in range(steps):
        change = torch.zeros_like(depth)
        for axis, alike in enumerate(joined):
            flow = torch.where(alike, depth.diff(dim=axis), 0.0)
            count = flow.shape[axis]
            change.narrow(axis, 0, count).add_(flow)
            change.narrow(axis, 1, count).sub_(flow)
        depth = depth + FAULTS.spread * change
    return depth


def estimate_noise(
    depth: Image,
    intrinsics: Matrix,
    table: Plane,
    on_table: Bool[Tensor, "h w"],
) -> SensorNoise | None:
    """Return a model of a camera's noise, estimated from a depth image of a table.

    It is None if fewer than 1000 pixels show the table. The fields `floor` [m] and `growth` [1/m]
    are its random part (`fit_noise`). `bias` [m] and `bias_width` [px] describe its smooth part.
    The depth (h, w) is in metres, the intrinsics are in pixels, and the plane is in the camera's
    frame. Of the pixels `on_table`, those over 20 mm from the plane do not count.
    """
    row, column = (torch.arange(n, dtype=torch.float64) for n in depth.shape)
    x = (column - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (row - intrinsics[1, 2]) / intrinsics[1, 1]
    a, b, c = table.normal.double().tolist()
    along = a * x + b * y[:, None] + c  # of a ray with depth 1 and the table's normal
    error = depth - table.offset / along  # (h, w)
    on = on_table & (depth > 0) & ((error * along).abs() < ESTIMATE.near)

    # The mean over the pixels of a patch that show the table is their bias.
    share = torch.from_numpy(ndimage.uniform_filter(on.double().numpy(), ESTIMATE.patch))
    total = ndimage.uniform_filter(torch.where(on, error, 0.0).numpy(), ESTIMATE.patch)
    mean = torch.from_numpy(total) / share.clamp_min(ESTIMATE.least_share)
    on = on & (share > ESTIMATE.full)
    if int(on.sum()) < ESTIMATE.least:
        return None
    random = fit_noise(depth[on], (error - mean)[on])
    bias = float(_deviation(mean[on] - mean[on].median()))
    return dataclasses.replace(random, bias=bias, bias_width=float(ESTIMATE.patch))


def fit_noise(depth: Float[Tensor, "n"], error: Float[Tensor, "n"]) -> SensorNoise:
    """Return a noise model whose random noise is fitted robustly to depth errors.

    At depth z [m] its standard deviation [m] is sqrt(floor^2 + (growth z^2)^2). The fields `floor`
    [m] and `growth` [1/m] are fitted, and others have their defaults. `error` holds the errors [m]
    of n pixels at the depths `depth` [m]. Fewer than 100 errors (`ESTIMATE.errors`) give
    `SensorNoise()`.
    """
    if len(depth) < ESTIMATE.errors:
        return SensorNoise()
    groups = torch.argsort(depth).tensor_split(ESTIMATE.groups)
    middle = torch.stack([depth[rows].median() for rows in groups])
    variance = torch.stack([_deviation(error[rows]).square() for rows in groups])
    terms = torch.stack([torch.ones_like(middle), middle**4], -1)
    floor, growth = np.sqrt(optimize.nnls(terms.numpy(), variance.numpy())[0]).tolist()
    return SensorNoise(floor=floor, growth=growth)


def _deviation(error: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Return the standard deviation of errors, from their median absolute value."""
    return ESTIMATE.gaussian * error.abs().median()


@checked
def median_depth(frames: Sequence[Tensor | np.ndarray]) -> Tensor:
    """Return one depth image (h, w): the median of each pixel over several depth images.

    It has the unit and the dtype of the frames. A pixel is 0 if half of the frames or more did not
    measure it (0, NaN or infinity).

    Args:
        frames: images (h, w) of one size, one unit and one dtype, taken while camera and scene
            stand still.

    Raises:
        BadArgument: no frame, or frames of several sizes or dtypes.
        BadArgument: camera or scene have moved: a frame differs from the median in more than 5 % of
            its pixels, or 1 % of its patches (`STILL`).

    >>> frames = [[[0.0, 0.7]], [[0.0, 0.701]], [[0.5, 0.702]]]
    >>> median_depth([torch.tensor(frame) for frame in frames])
    tensor([[0.0000, 0.7010]])
    """
    images = [as_tensor("frames", frame) for frame in frames]
    kinds = sorted({f"{tuple(image.shape)} {image.dtype}" for image in images})
    if len(kinds) != 1 or images[0].ndim != 2:
        found = " and ".join(kinds) or "none"
        raise BadArgument("frames", found, "images (h, w) of one size and one dtype")
    stack = torch.stack(images).double()  # (frames, h, w)
    stack = torch.where(torch.isfinite(stack) & (stack > 0), stack, torch.nan)
    middle = torch.nanquantile(stack, 0.5, dim=0)
    # The median of two is their mean, from which each is half as far. The noise is less by a root.
    scale = math.sqrt(2) if len(stack) == 2 else 1.0
    rows, columns = (min(STILL.side, side) for side in middle.shape)
    for number, frame in enumerate(stack, start=1):
        off = frame / middle - 1
        _check_still(number, "pixels", off.abs(), STILL.off, STILL.share)
        patches = scale * off.unfold(0, rows, rows).unfold(1, columns, columns)
        patches = patches.flatten(2)  # (rows, columns, pixels)
        half = 2 * torch.isfinite(patches).sum(-1) > patches.shape[-1]
        median = torch.where(half, patches.nanmedian(-1).values.abs(), torch.nan)
        _check_still(number, "patches", median, STILL.patch_off, STILL.patch_share)
    middle = torch.where(2 * torch.isfinite(stack).sum(0) > len(stack), middle, 0.0)
    whole = not images[0].is_floating_point()
    return (torch.round(middle) if whole else middle).to(images[0].dtype)


def _check_still(
    number: int, parts: str, off: Float[Tensor, "*b"], most: float, most_share: float
) -> None:
    """Raise `BadArgument` if a frame differs from the others by more than `most` in too many of its
    parts. Differences are shares of the depth; NaN is not measured.
    """
    share = float((off > most).sum()) / max(1, int(torch.isfinite(off).sum()))
    if share > most_share:
        more = f"{100.0 * most:g} %"
        found = f"frame {number} differs by more than {more} in {share:.1%} of its {parts}"
        allowed = f"frames of a camera and a scene that stand still (at most {most_share:.0%})"
        raise BadArgument("frames", found, allowed)
