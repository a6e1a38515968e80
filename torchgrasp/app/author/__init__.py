"""Authoring of hand files from published URDFs: repairs, fitted shapes, guessed fingertip pads, a
first hand.toml.
"""

from torchgrasp.app.author.draft import Draft, Wish, clean_arm, draft_hand, new_hand

__all__ = ["Draft", "Wish", "clean_arm", "draft_hand", "new_hand"]
