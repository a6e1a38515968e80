"""What a view does not tell, said to the user as a warning."""

import warnings

import torch

from torchgrasp.cloud.neighbours import nearest
from torchgrasp.cloud.parts import find_second_body
from torchgrasp.errors import CutOff, Gap, TwoBodies
from torchgrasp.shape.completion.silhouette import Outlines
from torchgrasp.values import PointCloud

LEAST_GAP = 0.025
"""Least width [m] of a gap that is told: a fingertip rests on the rim of a narrower one, as of a handle."""
CALLER = 5
"""Frames between a warning and the caller of `fit_shape`, to whom it is shown."""


def warn_of_doubts(cloud: PointCloud, outline: Outlines, on_table: bool) -> None:
    """Warn of a view that is cut off, has a gap, or shows two bodies on a table with normal z.

    >>> from torchgrasp.shape.completion import silhouettes
    >>> cap = torch.rand(400, 3).double() * torch.tensor([0.1, 0.1, 0.01])
    >>> cap = PointCloud(cap, None, torch.tensor([0.0, 0.0, 9.0]).double())
    >>> warn_of_doubts(cap, silhouettes(cap), on_table=True)
    """
    if outline.cut:
        _warn(CutOff, "the border of the image cuts the object off: the part beyond it is a guess; turn the camera")
    if outline.gap > LEAST_GAP:
        width = f"a gap of {1e3 * outline.gap:.0f} mm in the view"
        _warn(Gap, f"{width}: a hole, or a patch that was not measured; the surface there is a guess")
    if on_table:
        points = cloud.points.double().cpu()
        up, spacing = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), float(nearest(points, 2)[0][:, -1].median())
        body = find_second_body(points, up, spacing)
        if body is not None:
            share = float(body.double().mean())
            _warn(TwoBodies, f"two bodies that stand apart, the second of {share:.0%} of the points: give one of them")


def _warn(kind: type[Warning], sentence: str) -> None:
    """Show a warning at the call of `fit_shape`."""
    warnings.warn(sentence, kind, stacklevel=CALLER)
