"""How far a normal may be off: by the posterior, and where the surface bends faster than the kernel follows.

A Gaussian process is as sure of a normal at an edge as on a face, but it rounds the edge. Three independent parts are
added, with factors fitted to true surfaces by `scripts/train.py bands`:

* the posterior's own, as a fingertip feels it: the slope between points its width apart (at a point, samples of the
  thin plate are rough);
* the surface's error times its bend: where it bends, a place that is off has another normal;
* the bend that a short distance shows and a long one does not: an edge, whose sharpness is not known.
"""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import in_chunks
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.joint_posterior import distance_covariance
from torchgrasp.shape.posterior import Posterior, surface_deviation

FOOTPRINT = 0.012
"""Half the width [m] over which a fingertip feels the slope of the surface: the radius of its sphere."""
NEAR, MIDDLE, WIDE = 0.004, 0.008, 0.012
"""Half the widths [m] over which the bend is measured: with 8 mm for all of them the errors are told less well."""
OWN, BEND, EDGE, LEAST = 0.87, 1.38, 0.0042, 0.06
"""Factors of the three parts, the third a length [m], and what is always added [rad]: the noise of normals."""
CHUNK = 256
"""Points of a chunk: the covariances of their neighbours stay in the cache."""


@dataclasses.dataclass(frozen=True)
class NormalParts:
    """Variances [rad^2] of a normal's tilt in two directions of the surface, before their factors.

    `own` of the posterior, calibrated; `bend` of the surface's error; `edge` per squared length [1/m^2].
    """

    axes: Float[Tensor, "q 2 3"]
    own: Float[Tensor, "q 2"]
    bend: Float[Tensor, "q 2"]
    edge: Float[Tensor, "q 2"]

    def variance(self) -> Float[Tensor, "q 2"]:
        """Return the calibrated variance [rad^2] of the tilt in each direction."""
        return OWN**2 * self.own + BEND**2 * self.bend + EDGE**2 * self.edge + LEAST**2


def normal_parts(surface: Posterior, x: Float[Tensor, "q 3"], scale: float, factor: float) -> NormalParts:
    """Return the parts of the normals' variance at normalised points.

    Args:
        surface: the posterior of a single surface.
        x: on it, or near it.
        scale: length [m] of a normalised unit.
        factor: real deviations over the posterior's.
    """

    def evaluate(x: Tensor) -> tuple[Tensor, ...]:
        jet = surface.jet(x)
        axes, steep = _across(jet.normals), torch.linalg.vector_norm(jet.gradient, dim=-1)
        beside = x[:, None] + FOOTPRINT / scale * torch.cat([axes, -axes], 1)  # (q, 4, 3)
        spread = distance_covariance(surface, beside)
        steps = torch.cat([torch.eye(2), -torch.eye(2)], 1).to(x) / (2 * FOOTPRINT / scale)
        own = torch.einsum("ak,qkl,al->qa", steps, spread, steps).clamp(min=0.0)  # rounding
        own = factor**2 * own / (steep**2)[:, None]
        near, middle, wide = (_bend(surface, x, axes, steep, width / scale) / scale for width in (NEAR, MIDDLE, WIDE))
        error = factor * scale * surface_deviation(jet.variance, jet.gradient)
        along = torch.einsum("qaj,qbj->qab", axes, error[:, None, None] * middle)
        sharp = torch.einsum("qaj,qbj->qab", axes, near - wide)
        return axes, own, (along**2).sum(-1), (sharp**2).sum(-1)

    return NormalParts(*in_chunks(evaluate, x, CHUNK))


def _bend(surface: Posterior, x: Tensor, axes: Tensor, steep: Tensor, width: float) -> Float[Tensor, "q 2 3"]:
    """Return the change of the normal with each step along the surface, normalised, as a quotient over a width."""
    ahead, behind = (surface.mean_and_gradient((x[:, None] + s * axes).flatten(0, 1))[1] for s in (width, -width))
    return (ahead - behind).view_as(axes) / (2 * width * steep[:, None, None])


def _across(normals: Float[Tensor, "q 3"]) -> Float[Tensor, "q 2 3"]:
    """Return two unit tangents at right angles."""
    least = torch.eye(3).to(normals)[normals.abs().argmin(-1)]
    first = unit(torch.linalg.cross(normals, least))
    return torch.stack([first, torch.linalg.cross(normals, first)], 1)
