"""Drafts of hands from published URDFs: shapes fitted, fingertips guessed, hand.toml written."""

from torchgrasp.app.author.draft import Draft, Wish, draft_hand, new_hand

__all__ = ["Draft", "Wish", "draft_hand", "new_hand"]
