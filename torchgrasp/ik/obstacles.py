"""What the whole hand keeps clear of: neighbours of the target, and hidden space that is likely full."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value, check_number, settle
from torchgrasp.checks import checked
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.scene.occupancy import Occupancy

FULL = 0.3
"""Probability from which a voxel counts as full: 0.5 doubles the true collisions for 3 % more grasps."""
LEVELS = (0.1, 0.5, 0.8)
"""Other probabilities whose regions tell how likely a hand collides; each distance field takes a tenth of a second."""


@checked
@dataclasses.dataclass(frozen=True)
class Obstacles(Value):
    """Regions of ever greater probability to be full, as distances [m] from them.

    Args:
        field: signed distances from the region that counts as full.
        distances: from the regions of at least the probability of each of `levels`, not signed, on the same grid.
        levels: ascending.
        hard: whether links may not touch what counts as full; else that only costs success.

    >>> from torchgrasp import load_scene
    >>> from torchgrasp.scene import estimate_occupancy
    >>> scene = load_scene()
    >>> obstacles = Obstacles.of(estimate_occupancy(scene, 1))
    >>> neighbour = scene.cloud(2).points.double().mean(0)
    >>> obstacles.likelihood(neighbour[None], torch.tensor([0.03]))
    tensor(0.9000, dtype=torch.float64)
    """

    field: SignedDistanceField
    distances: Float[Tensor, "k x y z"]
    levels: Float[Tensor, "k"]
    hard: bool = True

    @classmethod
    @checked
    def of(cls, occupancy: Occupancy, full: float = FULL, hard: bool = True) -> "Obstacles | None":
        """Return the obstacles of an occupancy whose voxels count as full from a probability on; None: all is free.

        Raises:
            BadArgument: `full` outside [0.01, 1].
        """
        check_number("full", full, 0.01, 1.0)
        device, occupancy = occupancy.origin.device, settle(occupancy, torch.device("cpu"))  # SciPy's distances
        probability, levels = occupancy.probability, sorted({*LEVELS, full})
        if not bool((probability >= levels[0]).any()):
            return None
        distances = torch.stack([distance_to(probability >= level, occupancy.spacing) for level in levels])
        outside, inside = distances[levels.index(full)], depth_in(probability >= full, occupancy.spacing)
        field = SignedDistanceField(occupancy.origin.double(), occupancy.spacing, outside - inside)
        return cls(field, distances.float(), torch.tensor(levels, dtype=torch.float64), hard).to(device)

    @checked(gradients=True)
    def likelihood(self, centres: Float[Tensor, "*b s 3"], radius: Float[Tensor, "s"]) -> Float[Tensor, "*b"]:
        """Return the largest probability of a voxel that spheres [m] meet: the middle between two levels."""
        met = centres.new_zeros(centres.shape[:-2])
        levels = [*self.levels.tolist(), 1.0]
        for low, high, values in zip(levels, levels[1:], self.distances, strict=False):
            hit = dataclasses.replace(self.field, values=values).nearest_node(centres) < radius
            met = torch.where(hit.any(-1), (low + high) / 2, met)
        return met


def distance_to(region: Bool[Tensor, "x y z"], spacing: float) -> Float[Tensor, "x y z"]:
    """Return the distances [m] of voxels from the faces of a region, 0 inside; an empty one is out of the grid."""
    from scipy.ndimage import distance_transform_edt

    if not bool(region.any()):
        return torch.full(region.shape, spacing * sum(region.shape), dtype=torch.float64)
    steps = torch.from_numpy(np.asarray(distance_transform_edt(~region.numpy())))
    return (spacing * (steps - 0.5)).clamp_min(0.0)


def depth_in(region: Bool[Tensor, "x y z"], spacing: float) -> Float[Tensor, "x y z"]:
    """Return how deep [m] voxels lie in a region, 0 outside."""
    depth = torch.zeros(region.shape, dtype=torch.float64)
    if bool(region.any()):
        where = torch.nonzero(region)  # only the box of the region is transformed
        low, high = (where.amin(0) - 1).clamp_min(0).tolist(), (where.amax(0) + 2).tolist()
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        depth[box] = distance_to(~region[box], spacing)
    return depth
