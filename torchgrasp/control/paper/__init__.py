"""Baselines: the paper's control law, position control, object impedance, learned stability. Not
public.
"""
