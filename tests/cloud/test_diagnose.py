"""Views of a ball with one fault each: advice names the fault, and only where it is large."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.make import directions
from torchgrasp import Plane, PointCloud
from torchgrasp.cloud.diagnose import diagnose_cloud
from torchgrasp.geometry.linalg import across, fibonacci_sphere, unit

EYE = torch.tensor([0.0, 0.0, 1.2], dtype=torch.float64)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def seen_ball(n: int = 600, radius: float = 0.05) -> Tensor:
    """What a camera above sees of a ball on z = 0: n evenly spread points, none of them edge-on."""
    return radius * (fibonacci_sphere(3 * n)[:n] + UP)


def told(points: Tensor, normals: Tensor | None = None, table: Plane | None = None) -> str:
    """All advice on the points, whose camera is known."""
    report = diagnose_cloud(PointCloud(points, normals, EYE), table=table)
    return "\n".join(map(str, report.advice))


def long(length: float) -> str:
    """Advice on a ball of another diameter [m]."""
    return told(seen_ball(radius=length / 2))


def dense(n: float) -> str:
    """Advice on a ball of another number of points."""
    return told(seen_ball(int(n)))


def noisy(std: float) -> str:
    """Advice on a ball with noise [m] along the camera's rays."""
    points = seen_ball(400)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(len(points), 1, generator=generator, dtype=torch.float64)
    return told(points + std * noise * unit(points - EYE))


def strewn(share: float, along: bool | None = None) -> str:
    """Advice on a ball of which a share of the points is 30 mm off: along the camera's rays, across
    them, or anywhere.
    """
    points = seen_ball()
    rows = torch.arange(0, len(points), round(1 / share))
    rays = unit(points[rows] - EYE)
    off = directions(len(rows))
    if along is not None:
        off = rays if along else across(rays)[0]
    points[rows] += 0.03 * off
    return told(points)


def inward(share: float) -> str:
    """Advice on a ball of which a share of the normals points inward."""
    points = seen_ball()
    normals = unit(points - 0.05 * UP)
    normals[:: round(1 / share)] *= -1
    return told(points, normals)


def afloat(height: float) -> str:
    """Advice on a ball whose lowest point is a height [m] above the table."""
    points = seen_ball()
    return told(points, table=Plane(UP, float(points[:, 2].min()) - height))


@pytest.mark.parametrize(
    ("words", "advice", "small", "large"),
    [
        ("large for a hand", long, 0.3, 0.5),
        ("of which 2000 are used", dense, 3000, 5000),
        ("too few for a shape", dense, 120, 80),
        ("the shape is mostly guessed", dense, 120, 80),
        ("blur the normals", noisy, 0.002, 0.01),
        ("far from the others", strewn, 0.025, 0.1),
        ("flipped normals", inward, 0.02, 0.06),
        ("above its table", afloat, 0.05, 0.1),
    ],
)
def test_a_fault_is_told_where_it_is_large(
    words: str, advice: Callable[[float], str], small: float, large: float
):
    assert words not in advice(small)
    assert words in advice(large)


def test_strays_along_the_rays_of_the_camera_are_flying_pixels():
    """Two rims blend in such a pixel; noise of other kinds goes to any side."""
    assert "flying pixels" not in strewn(0.01, along=True)
    assert "flying pixels" in strewn(0.05, along=True)
    assert "flying pixels" not in strewn(0.05, along=False)
