"""Trials: a hand closes on the true object, which is lifted or pulled at; protocols, evaluations, tables."""
