"""An analytic shape as a stand-in of the learned one: an ellipsoid whose uncertainty grows away
from a camera.
"""

import dataclasses

import pytest
import torch
from torch import Tensor

from tests.make import half_ball as ball
from torchgrasp import ShapeGP
from torchgrasp.shape.estimate import SurfaceJet


@dataclasses.dataclass(frozen=True)
class Ellipsoid:
    """q(x) = (|x / axes|^2 - 1) / 2 as distance, variance c (1 - x . view)^2, all in normalised
    units.
    """

    axes: tuple[float, float, float] = (1.0, 0.6, 0.5)
    view: tuple[float, float, float] = (0.6, 0.8, 0.0)
    doubt: float = 0.02
    scale: float = 0.06
    domain_radius: float = 1.35
    std_factor: float = 0.65
    center: tuple[float, float, float] = (0.3, -0.2, 0.5)

    def value(self, x: Tensor) -> Tensor:
        return (((x / x.new_tensor(self.axes)) ** 2).sum(-1) - 1) / 2

    def doubt_at(self, x: Tensor) -> Tensor:
        return self.doubt * (1 - x @ x.new_tensor(self.view)) ** 2

    def jet(self, x: Tensor) -> SurfaceJet:
        inverse = 1 / x.new_tensor(self.axes) ** 2
        view = x.new_tensor(self.view)
        behind = 1 - x @ view
        return SurfaceJet(
            self.value(x),
            x * inverse,
            torch.diag(inverse).expand(len(x), 3, 3),
            self.doubt_at(x),
            -2 * self.doubt * behind[:, None] * view,
        )

    def mean_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.value(x), x / x.new_tensor(self.axes) ** 2

    def normalise(self, points: Tensor) -> Tensor:
        return (points - points.new_tensor(self.center)) / self.scale

    def metres(self, x: Tensor) -> Tensor:
        return x * self.scale + x.new_tensor(self.center)


@pytest.fixture
def ellipsoid() -> Ellipsoid:
    return Ellipsoid()


@pytest.fixture(scope="session")
def doubtful() -> ShapeGP:
    return ball(-0.2, std_factor=0.4)
