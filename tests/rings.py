"""Postures of one joint that goes round, with a code that follows it: what tests of fits start from."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from torchgrasp.posture_model.sample import HandSamples


def ring(n: int = 3000) -> HandSamples:
    """One joint that goes round, and a code that follows it."""
    rng = np.random.default_rng(7)
    angle = rng.uniform(0, 6, size=n)
    lengths = 0.05 + 0.01 * np.stack([np.sin(angle), np.cos(angle), np.sin(2 * angle)], -1)
    cosines = np.stack([np.cos(angle), np.sin(angle), np.cos(3 * angle)], -1)
    q = np.concatenate([lengths, cosines], -1) + rng.normal(size=(n, 6)) * np.repeat([1e-3, 0.05], 3)
    return HandSamples(torch.from_numpy(angle[:, None]), torch.from_numpy(q), ("turn",))


def run_python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a process of its own that can import the library and the helpers of the tests."""
    root = str(Path(__file__).parents[1])
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, env=os.environ | {"PYTHONPATH": path})
