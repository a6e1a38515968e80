"""The course in time of motions that start and end at rest."""


def smooth_step(time: float) -> tuple[float, float]:
    """Return (position, speed) at a `time` t of a motion from 0 to 1 that starts and ends at rest.

    t runs from 0 to 1. The position is the cubic 3 t^2 - 2 t^3; nothing has a unit.
    """
    return time * time * (3 - 2 * time), 6 * time * (1 - time)
