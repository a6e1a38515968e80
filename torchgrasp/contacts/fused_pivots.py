"""The simplex method of `torchgrasp.contacts.form_closure.maximise` as one compiled loop over
linear programmes.
"""

import math

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled


@compiled
def _pivot(objective, bounds, numbers, tight, ray):
    """Write the tight bounds and the rays of all programmes, as `pivot` returns them."""
    pivots, optimal, first, parallel = numbers
    b, m, d = bounds.shape
    inverse = np.empty((d, d))
    step = np.empty(d)
    change = np.empty(d)
    slack = np.empty(m)
    rate = np.empty(m)
    held = np.empty(m, np.bool_)
    for g in range(b):
        inverse[:] = 0.0
        for i in range(d):
            inverse[i, i] = 1.0
        slack[:] = 1.0
        held[:] = False
        for _ in range(pivots):
            most = optimal
            leaving = -1
            sign = -1.0
            for j in range(d):
                multiplier = 0.0
                for i in range(d):
                    multiplier += objective[g, i] * inverse[i, j]
                gain = -multiplier
                if tight[g, j] < 0:
                    gain = abs(multiplier)
                    if gain > optimal:
                        gain += first
                if gain > most:
                    most = gain
                    leaving = j
                    sign = 1.0 if tight[g, j] < 0 and multiplier > 0 else -1.0
            if leaving < 0:
                break
            square = 0.0
            for i in range(d):
                step[i] = sign * inverse[i, leaving]
                square += step[i] * step[i]
            least = parallel * math.sqrt(square)
            length = math.inf
            entering = -1
            for k in range(m):
                rate[k] = 0.0
                for i in range(d):
                    rate[k] += bounds[g, k, i] * step[i]
                if rate[k] > least and not held[k] and slack[k] / rate[k] < length:
                    length = slack[k] / rate[k]
                    entering = k
            if entering < 0:
                ray[g] = step
                break
            for k in range(m):  # whole rows would each take an array
                slack[k] -= max(length, 0.0) * rate[k]
            for j in range(d):
                change[j] = 0.0
                for i in range(d):
                    change[j] += bounds[g, entering, i] * inverse[i, j]
            share = sign / change[leaving]
            change[leaving] -= 1.0
            for i in range(d):
                for j in range(d):
                    inverse[i, j] -= share * step[i] * change[j]
            if tight[g, leaving] >= 0:
                held[tight[g, leaving]] = False
            held[entering] = True
            tight[g, leaving] = entering


def pivot(
    objective: Float[Tensor, "b d"],
    bounds: Float[Tensor, "b m d"],
    numbers: tuple[int, float, float, float],
) -> tuple[Int[Tensor, "b d"], Float[Tensor, "b d"]]:
    """Return for each of b linear programmes the indices of its d tight bounds, then a direction.

    The programmes are: maximise a.v with c_k.v <= 1 for m bounds c_k. `objective` holds a, and
    `bounds` the c_k. An index is -1 for an artificial bound, one of v = 0, that stayed tight. The
    direction is that in which a.v grows without bound, or 0. The `numbers` are the most pivots and
    the multiplier that counts as zero. Then follow the gain of artificial bounds, and the least
    rate of approach to a bound.
    """
    tight = objective.new_full(objective.shape, -1).long()
    ray = objective.new_zeros(objective.shape)
    _pivot(array(objective), array(bounds), numbers, tight.numpy(), ray.numpy())
    return tight, ray
