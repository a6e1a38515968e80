"""Closing and hold controllers, by the names of their modes."""

import functools
from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.finger_forces import ForcePreference
from torchgrasp.control.holding import ForceHold, GripHold, keep_targets
from torchgrasp.control.paper.closings import (
    Impedance,
    OpenLoopClosing,
    PaperClosing,
    PositionClosing,
)
from torchgrasp.control.paper.stability import load_stability
from torchgrasp.control.protocol import Closing, Step
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import Observation
from torchgrasp.control.uncertainty_closing import UncertaintyClosing, with_equal_gains
from torchgrasp.hand.hand import Hand
from torchgrasp.values.closing import ClosingOptions
from torchgrasp.values.specs import ClosingMode, HoldingMode


def choose_preference(hand: Hand, mode: ClosingMode) -> ForcePreference | None:
    """Return the model by which a closing mode chooses among balanced fingertip forces.

    It is the stability model in the hand's folder for the mode "paper". None for other modes, or a
    hand without such a file. Raises `BadArgument` for the mode "paper" with a hand of other than
    three fingers.
    """
    if mode != "paper":
        return None
    hand.require_three("closing", "'paper', whose model of stability is of three,")
    return load_stability(hand)


def make_closing(
    reference: ClosingReference, mode: ClosingMode, options: ClosingOptions
) -> Closing:
    """Return the controller of a closing mode, such as "paper", which closes the hand by the plan
    `reference`.

    `options` apply to the modes "fixed" and "uncertainty" only; other modes ignore them.
    """
    match mode:
        case "open_loop":
            return OpenLoopClosing(reference)
        case "position":
            return PositionClosing(reference)
        case "paper_position":
            return PositionClosing(reference, depth=0.0)
        case "paper":
            return PaperClosing(reference)
        case "fixed":
            return UncertaintyClosing(with_equal_gains(reference), options)
        case "uncertainty":
            return UncertaintyClosing(reference, options)


def choose_holding(
    hand: Hand, mode: HoldingMode
) -> Callable[[ClosingReference, Observation, Float[Tensor, " j"]], Step] | None:
    """Return the function that makes a mode's hold controller, or None for the mode "law".

    The function takes the plan, the last observation and the joint targets (j,) [rad] at the end of
    the closing. j counts all joints of the URDF. With "law" the closing controller itself goes on
    to press. Raises `BadArgument` for "impedance" with a hand of other than three fingers.
    """
    if mode == "impedance":
        hand.require_three("holding", "'impedance', whose virtual frame is of three,")
        return functools.partial(Impedance, stability=load_stability(hand))
    return {"force": ForceHold, "grip": GripHold, "position": keep_targets}.get(mode)
