"""The course in time of motions that start and end at rest."""


def smooth_step(time: float) -> tuple[float, float]:
    """Return (position, speed) of a motion from 0 to 1 that starts and ends at rest.

    The `time` is in [0, 1]; all are without unit.
    """
    return time * time * (3 - 2 * time), 6 * time * (1 - time)
