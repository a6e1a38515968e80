"""The distance fields of several objects as one: each row of points is asked in the field of its
own object.
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
    """The fields of c objects as one: row r of all points that a method is given belongs to field
    `owner[r]`.
    """

    nodes: Float[Tensor, "n"]  # the values of all fields, one after another
    places: Float[Tensor, "c 4"]  # origin and spacing [m] of the nodes of each field
    # of each field: last nodes, strides on x and y, first value, steps to a cell's corners
    steps: Int[Tensor, "c 14"]
    owner: Int[Tensor, "r"]  # the field of each row

    @classmethod
    def of(cls, fields: Sequence[SignedDistanceField]) -> "FieldBatch":
        """Join fields, with one row for each."""
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
        """The spacing [m] of the nodes, of each row."""
        return self._own[0][:, 3]

    def rows(self, index: Int[Tensor, "k"]) -> "FieldBatch":
        """Return the fields of some of the rows of points."""
        return dataclasses.replace(self, owner=self.owner[index])

    @kept
    def _own(self) -> tuple[Float[Tensor, "r 4"], Int[Tensor, "r 14"]]:
        """The places and steps of each row."""
        return self.places[self.owner], self.steps[self.owner]

    def _grid(self, points: Float[Tensor, "b *k 3"]) -> Grid:
        place, step = (x.view(len(x), *[1] * (points.ndim - 2), -1) for x in self._own)
        place = place.to(points)
        stride = (step[..., 3], step[..., 4])
        corners = step[..., 6:].movedim(-1, 0)
        return Grid(place[..., :3], place[..., 3:], step[..., :3], stride, step[..., 5], corners)
