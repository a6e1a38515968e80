"""Warnings that name the line of the user's code."""

import sys
import warnings
from types import FrameType


def warn_user(kind: type[Warning], sentence: str) -> None:
    """Show a warning of the class `kind` with the text `sentence`. It names the line of the user's
    code that called the library.
    """
    frame: FrameType | None = sys._getframe()
    level = 0
    last = 0  # level of the outermost frame of the library
    while frame is not None:
        level += 1
        if frame.f_globals.get("__name__", "").startswith("torchgrasp."):
            last = level
        frame = frame.f_back
    warnings.warn(sentence, kind, stacklevel=last + 1)
