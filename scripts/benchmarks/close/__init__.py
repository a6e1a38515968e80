"""Closing the hand, beside its bars."""
