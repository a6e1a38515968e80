"""Distance fields of several objects in one value. It finds the distances of many points at once,
each from the object of the point.
"""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import kept
from torchgrasp.geometry.signed_distance import (
    DistanceField,
    Grid,
    SignedDistanceField,
    corner_steps,
)


@dataclasses.dataclass(frozen=True)
class FieldBatch(DistanceField):
    """The joined distance fields of c objects: each entry of a batch of points can have its own
    field.

    The batch has r entries. Points given to a method have the shape (r, ..., 3). The points of
    entry i belong to the field with the index `owner[i]`. They are in the frame of its object. Each
    field is a grid of nodes, between which it is interpolated. `nodes` holds the n distances [m] of
    all grids, `places` their origins and spacings [m], and `steps` the layout of each in `nodes`.
    Make a batch with `of`.
    """

    # signed distances [m] at all nodes of all c fields, one field after another
    nodes: Float[Tensor, "n"]
    # origin (x, y, z) [m] of each field, and the spacing [m] of its nodes
    places: Float[Tensor, "c 4"]
    # Of each field: 3 indices of the last node on each axis, and 2 strides on x and y. Then the
    # index of the first value in `nodes`, and 8 steps from a cell's first corner to its corners.
    steps: Int[Tensor, "c 14"]
    owner: Int[Tensor, "r"]  # index of the field of each entry of the batch

    @classmethod
    def of(cls, fields: Sequence[SignedDistanceField]) -> "FieldBatch":
        """Return c distance fields joined to a batch of c entries, where entry i has field i."""
        nodes = torch.cat([x.nodes for x in fields])
        shape = torch.tensor([x.values.shape for x in fields], device="cpu")
        places = torch.stack(
            [torch.cat([x.origin, x.origin.new_tensor([x.spacing])]) for x in fields]
        )
        counts = shape.prod(1)
        dy = shape[:, 2]
        dx = shape[:, 1] * dy
        strides = torch.stack([dx, dy, counts.cumsum(0) - counts], 1)
        steps = torch.cat([shape - 1, strides, corner_steps(dx, dy).T], 1).to(nodes.device)
        return cls(nodes, places, steps, torch.arange(len(fields), device=nodes.device))

    @property
    def spacing(self) -> Float[Tensor, "r"]:
        """The distance (r,) [m] between neighbouring nodes of each entry's field."""
        return self._own[0][:, 3]

    def rows(self, index: Int[Tensor, "k"]) -> "FieldBatch":
        """Return a batch whose entry k has the field of this batch's entry `index[k]`."""
        return dataclasses.replace(self, owner=self.owner[index])

    @kept
    def _own(self) -> tuple[Float[Tensor, "r 4"], Int[Tensor, "r 14"]]:
        """The `places` and the `steps` of each entry's field."""
        return self.places[self.owner], self.steps[self.owner]

    def _grid(self, points: Float[Tensor, "b *k 3"]) -> Grid:
        place, step = (x.view(len(x), *[1] * (points.ndim - 2), -1) for x in self._own)
        place = place.to(points)
        stride = (step[..., 3], step[..., 4])
        corners = step[..., 6:].movedim(-1, 0)
        return Grid(place[..., :3], place[..., 3:], step[..., :3], stride, step[..., 5], corners)
