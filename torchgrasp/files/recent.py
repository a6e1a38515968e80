"""The last few things that were read from disk, kept for the next who asks."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

Thing = TypeVar("Thing")


class Recent(Generic[Thing]):
    """At most so many things by number, those asked for last; a copy in another process begins empty.

    >>> recent = Recent(1)
    >>> recent.get(3, str), recent.get(3, hex), recent.get(4, str), recent.get(3, hex)
    ('3', '3', '4', '0x3')
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.kept: dict[int, Thing] = {}

    def get(self, number: int, read: Callable[[int], Thing]) -> Thing:
        """Return the thing of a number, read if it is not at hand."""
        thing = self.kept.pop(number, None)
        thing = read(number) if thing is None else thing
        self.kept[number] = thing  # now the last one
        for oldest in list(self.kept)[: -self.most]:
            self.kept.pop(oldest, None)
        return thing

    def __reduce__(self) -> tuple[Any, ...]:
        """Leave behind what was read: each worker of a DataLoader reads for itself."""
        return Recent, (self.most,)
