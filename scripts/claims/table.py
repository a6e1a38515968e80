"""The table of claims: a text of a page, and what a run finds in its place."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
Finding = tuple[str, bool]
"""What was found, and whether the claim holds."""


class Claim(NamedTuple):
    """A text of a page, and the function that measures it again."""

    page: str
    said: str
    check: Callable[[], Finding]

    def stands(self) -> bool:
        """Return whether the page still has the text; line breaks count as spaces."""
        return self.said in " ".join((ROOT / self.page).read_text("utf-8").split())


CLAIMS: list[Claim] = []
"""All claims, in the order in which `measured.py` registers them."""


def claim(page: str, *said: str) -> Callable[[Callable[[], Finding]], Callable[[], Finding]]:
    """Register the function that measures one or several texts of a page again."""

    def register(check: Callable[[], Finding]) -> Callable[[], Finding]:
        CLAIMS.extend(Claim(page, text, check) for text in said)
        return check

    return register
