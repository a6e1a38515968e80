"""A depth image above its table: points, heights and the noise of the table, each computed once."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.sensor import fit_noise
from torchgrasp.foundation.base import Value, kept
from torchgrasp.foundation.lazy import ndimage
from torchgrasp.geometry.support_planes import SupportPlane
from torchgrasp.scene.image import DepthImage


@dataclasses.dataclass(frozen=True)
class HeightNumbers:
    """Parameters of the image of heights above a table, and of the noise of these heights."""

    window: int = 5
    """Side [px] of the square over which heights are averaged."""
    band: float = 0.010
    """Greatest absolute value [m] of mean heights that measure the noise of the table."""
    foot: float = 0.030
    """Greatest distance [m] from the table of a pixel whose height is averaged. The mean at an
    object's foot leaves out higher parts.
    """
    normal: float = 1.4826
    """Ratio of the standard deviation to the median absolute value of a normal distribution."""
    jump: float = 0.006
    """Least jump of depth between two surfaces [m], in addition to the change that a slope
    causes.
    """
    slope: float = 2.0
    """Largest change of depth of one surface from pixel to pixel, in widths of a pixel."""
    least_share: float = 1e-9
    """Least share of averaged pixels that is a divisor, so that nothing is divided by 0."""


HEIGHT = HeightNumbers()


@dataclasses.dataclass(frozen=True)
class TableImage(Value):
    """A depth image with the support of the objects in it.

    Attributes:
        image: the depth image.
        points: the point [m] of each pixel, in the frame to which the image's pose leads.
        support: plane and visible region of the table, in the same frame.
    """

    image: DepthImage
    points: Float[Tensor, "h w 3"]
    support: SupportPlane

    @classmethod
    def of(cls, image: DepthImage, support: SupportPlane) -> "TableImage":
        """Return the table image of a depth image and the support of its objects.

        The points of the pixels are computed from the depth. The `support` is in the frame to which
        the image's pose leads.
        """
        return cls(image, image.points(), support)

    @property
    def measured(self) -> Bool[Tensor, "h w"]:
        """Mask of the pixels at which a depth was measured."""
        return self.image.depth > 0

    @kept
    def height(self) -> Float[Tensor, "h w"]:
        """The height of each pixel's point above the table [m].

        Where nothing was measured, it is the camera's height.
        """
        return self.support.plane.height(self.points)

    @kept
    def smooth(self) -> "TableImage":
        """The image without speckle, above the same support.

        Each depth is replaced by the median of the 3 x 3 pixels around it.
        """
        return TableImage.of(self.image.without_speckle(), self.support)

    @kept
    def mean_height(self) -> Float[Tensor, "h w"]:
        """The mean height [m] above the table of the 5 x 5 pixels around each pixel.

        Only measured pixels within 30 mm (`HEIGHT.foot`) of the table count; all others keep their
        height.
        """
        near = self.measured & (self.height.abs() < HEIGHT.foot)
        share = torch.from_numpy(ndimage.uniform_filter(near.double().numpy(), HEIGHT.window))
        low = torch.where(near, self.height, 0.0)
        total = torch.from_numpy(ndimage.uniform_filter(low.numpy(), HEIGHT.window))
        return torch.where(near, total / share.clamp_min(HEIGHT.least_share), self.height)

    @kept
    def flat(self) -> Bool[Tensor, "h w"]:
        """Mask of the pixels on the table, by which the noise of its heights is estimated.

        Their mean heights are within 10 mm (`HEIGHT.band`) of the table.
        """
        return self.measured & (self.mean_height.abs() < HEIGHT.band)

    @kept
    def median_noise(self) -> float:
        """The standard deviation [m] of the noise of the table's heights over the squared depth
        [m^2]: a number [1/m].

        It is 1.4826 times the median of |mean height| / depth^2 over the pixels on the table
        (`flat`). A few outliers do not move it. It is 0 if no pixel shows the table.
        """
        if not self.flat.any():
            return 0.0
        relative = (self.mean_height.abs() / self.image.depth.square())[self.flat]
        return HEIGHT.normal * float(relative.median())

    @kept
    def fitted_noise(self) -> Float[Tensor, "h w"]:
        """The standard deviation [m] of the mean height of a table, at each pixel's depth.

        It is that of a model fitted to the pixels on the table (`SensorNoise.sigma`). The model has
        a constant part, and one that grows with the squared depth.
        """
        depth = self.image.depth
        return fit_noise(depth[self.flat], self.mean_height[self.flat]).sigma(depth)

    @kept
    def jump(self) -> Float[Tensor, "h w"]:
        """The least difference in depth [m], at each pixel, that counts as a jump to another
        surface.

        It is 6 mm (`HEIGHT.jump`) plus twice the width of the pixel at its depth (`HEIGHT.slope`).
        """
        return HEIGHT.jump + HEIGHT.slope * self.image.depth / self.image.focal
