"""The test of three contacts in their plane, of `torchgrasp.contacts.form_closure.closed_exact`, as
one compiled loop over contact sets.
"""

import math

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_vectors import add, cross, dot, minus, scale


@inlined
def _unit(v):
    """Return a vector divided by its length."""
    return scale(v, 1.0 / math.sqrt(dot(v, v)))


@inlined
def _cut(planar, points, normals, cone):
    """Write the six planar wrenches along the sides of the friction cones.

    Return whether the plane of the contacts cuts all cones. `cone` is the cosine of the angle
    between a cone's axis and its surface.
    """
    centre = scale(add(add(points[0], points[1], 1.0), points[2], 1.0), 1.0 / 3.0)
    square = 0.0
    for c in range(3):
        arm = minus(points[c], centre)
        square += dot(arm, arm)
    shrink = 1.0 / math.sqrt(square / 3.0)  # torques have no unit
    along = _unit(minus(points[1], points[0]))
    across = _unit(cross(along, minus(points[2], points[0])))
    other = cross(across, along)
    for c in range(3):
        arm = minus(points[c], centre)
        x = shrink * dot(arm, along)
        y = shrink * dot(arm, other)
        inward_x = -dot(normals[c], along)
        inward_y = -dot(normals[c], other)
        projected = math.sqrt(inward_x * inward_x + inward_y * inward_y)
        if not projected > cone:
            return False
        # the axis, turned by half of the angle between the sides, either way
        cosine = cone / projected
        sine = math.sqrt(1.0 - cosine * cosine)
        for side in range(2):
            force_x = (inward_x * cosine - inward_y * sine) / projected
            force_y = (inward_y * cosine + inward_x * sine) / projected
            planar[2 * c + side, 0] = force_x
            planar[2 * c + side, 1] = force_y
            planar[2 * c + side, 2] = x * force_y - y * force_x
            sine = -sine
    return True


@inlined
def _spans(planar, parallel):
    """Return whether six planar wrenches positively span all planar wrenches.

    No plane through two of them may have the others on one side.
    """
    spans = False
    for i in range(6):
        for j in range(i + 1, 6):
            plane = cross(planar[i], planar[j])
            if math.sqrt(dot(plane, plane)) > parallel:
                spans = True
                least = 0.0
                most = 0.0
                for k in range(6):
                    side = dot(plane, planar[k])
                    least = min(least, side)
                    most = max(most, side)
                if not (most > parallel and least < -parallel):
                    return False
    return spans


@inlined
def _is_triangle(points, flat):
    """Return whether three points are not nearly on a line, as `degenerate` defines it."""
    first = minus(points[1], points[0])
    second = minus(points[2], points[0])
    third = minus(points[2], points[1])
    longest = max(dot(first, first), dot(second, second), dot(third, third))
    area = cross(first, second)
    return math.sqrt(dot(area, area)) > flat * longest


@compiled
def _put_closed(points, normals, numbers, closed):
    """Write for each contact set whether it has force closure."""
    cone, parallel, flat = numbers
    planar = np.empty((6, 3))
    for g in range(len(points)):
        closed[g] = (
            _cut(planar, points[g], normals[g], cone)
            and _spans(planar, parallel)
            and _is_triangle(points[g], flat)
        )


def closed_in_plane(
    points: Float[Tensor, "b 3 3"],
    normals: Float[Tensor, "b 3 3"],
    friction: float,
    parallel: float,
    flat: float,
) -> Bool[Tensor, "b"]:
    """Return a mask of the sets of three contacts with frictional form closure under round cones.

    `points` [m] and outward unit `normals` are in one frame, and `friction` is the coefficient of
    friction. Planar wrenches with a cross product shorter than `parallel` count as parallel.
    Contacts count as on a line if their triangle is small. Twice its area is then at most `flat`
    times the square of its longest side.
    """
    closed = points.new_zeros(len(points)).bool()
    cone = math.cos(math.atan(friction))
    _put_closed(array(points), array(normals), (cone, parallel, flat), closed.numpy())
    return closed
