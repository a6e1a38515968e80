"""The closings and holdings by their names, and which of them go together."""

import functools
from collections.abc import Callable
from typing import get_args

from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.closing import FixedGainClosing, LawClosing, OpenLoopClosing, PositionClosing, Revision
from torchgrasp.control.holding.force import ForceHold, PositionHold
from torchgrasp.control.holding.grip import GripHold
from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.errors import BadArgument
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ClosingMode, ClosingPart, HoldingMode, check_closing_parts

Step = Callable[[Observation, float], Float[Tensor, " j"]]
"""Turns what is known, and the time to the next tick [s], into the targets of all joints [rad]."""

Closing = OpenLoopClosing | PositionClosing | LawClosing
"""The closings."""


def check_modes(closing: str, holding: str, belief: object = None, without: tuple[str, ...] = ()) -> None:
    """Refuse what a closing has not: parts, a law (Eq. 25) to hold with or to revise."""
    if belief is not None and closing not in ("fixed", "uncertainty"):
        raise BadArgument("belief", f"one for {closing!r}", "None, or a closing under the law")
    if holding == "law" and closing not in ("fixed", "uncertainty", "paper"):
        raise BadArgument("holding", f"'law' after {closing!r}", "another, or a closing under the law")
    check_closing_parts(closing, without)


def make_closing(
    reference: ClosingReference, mode: ClosingMode, belief: ShapeGP | None, without: tuple[ClosingPart, ...]
) -> Closing:
    """Return the closing of a mode."""
    if mode == "open_loop":
        return OpenLoopClosing(reference)
    if mode == "position":
        return PositionClosing(reference)
    if mode == "paper_position":
        return PositionClosing(reference, depth=0.0)
    if mode == "paper":
        return LawClosing(reference, without=get_args(ClosingPart))
    revise: Revision | None = None
    if belief is not None:
        from torchgrasp.control.adaptive.belief import Belief

        revise = Belief(belief, reference.obj_from_hand).revise
    return (FixedGainClosing if mode == "fixed" else LawClosing)(reference, revise, without)


def choose_holding(
    closing: Closing, mode: HoldingMode
) -> Callable[[ClosingReference, Observation, Float[Tensor, " j"]], Step]:
    """Return the maker of a holding; only the impedance reads the stability model."""
    if mode == "impedance":
        closing.reference.hand.require_three("holding", "'impedance', whose virtual frame is of three,")
        from torchgrasp.control.adaptive.impedance import Impedance
        from torchgrasp.control.adaptive.stability import load_stability

        return functools.partial(Impedance, stability=load_stability(closing.reference.hand))
    if mode == "law" and isinstance(closing, LawClosing):
        return lambda *_: closing.press()
    return {"force": ForceHold, "grip": GripHold}.get(mode, PositionHold)
