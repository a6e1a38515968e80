"""Authoring of hand files from published URDFs: repairs, fitted shapes, guessed fingertip pads, a
first hand.toml.
"""

from typing import TYPE_CHECKING

from torchgrasp.foundation.lazy import import_late

if TYPE_CHECKING:
    from torchgrasp.app.author.draft import Draft, Wish, clean_arm, draft_hand, new_hand

__all__ = ["Draft", "Wish", "clean_arm", "draft_hand", "new_hand"]

__getattr__ = import_late(__name__, **dict.fromkeys(__all__, "draft"))
