"""Kernels on a GPU beside the CPU."""
