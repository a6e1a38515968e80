"""Bit masks that let named pairs of a hand's links collide, and no other two of them."""

from collections.abc import Iterable

from torchgrasp.errors import HandFileError

BITS = 31
"""Bits of a mask: MuJoCo's are signed numbers of 32 bits."""


def pair_masks(pairs: Iterable[tuple[str, str]], first: int) -> dict[str, tuple[int, int]]:
    """Return for each link of the pairs what it is and what it hits, as masks.

    Two links collide if what one is shares a bit with what the other hits, as in PhysX and MuJoCo. Only one link of
    each pair needs a bit of its own.

    Args:
        pairs: names of links.
        first: number of the first bit that is free.

    Raises:
        HandFileError: the pairs need more bits than there are.

    >>> pair_masks([("palm", "thumb"), ("index", "thumb")], first=1)
    {'palm': (0, 2), 'thumb': (2, 0), 'index': (0, 2)}
    """
    left = [tuple(pair) for pair in pairs]
    kinds, hits = (dict.fromkeys((name for pair in left for name in pair), 0) for _ in range(2))
    for bit in range(first, BITS):
        if not left:
            break
        names = [name for pair in left for name in pair]
        owner = max(kinds, key=names.count)  # of equal ones the first
        kinds[owner] = 1 << bit
        for one, two in left:
            if owner in (one, two):
                hits[two if one == owner else one] |= 1 << bit
        left = [pair for pair in left if owner not in pair]
    if left:
        raise HandFileError(
            "self_collision", f"{len(left)} pairs too many", f"links that {BITS - first} bits tell apart"
        )
    return {name: (kinds[name], hits[name]) for name in kinds}
