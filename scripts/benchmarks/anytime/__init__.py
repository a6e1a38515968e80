"""Grasps as they come: how soon the first are there, how many a second, what waiting is worth."""
