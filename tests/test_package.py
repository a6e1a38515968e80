"""What importing torchgrasp does and leaves alone, and what its source never contains."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "torchgrasp").rglob("*.py"))


def run(code, folder):
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_brings_in_no_simulator_and_nothing_that_draws(tmp_path):
    code = "import sys, torchgrasp; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = set(run(code, tmp_path).split())
    assert "torchgrasp" in loaded
    assert not loaded & {"sapien", "coacd", "viser", "pyvista", "vtk", "vtkmodules", "matplotlib", "skimage", "sklearn"}


def test_import_changes_no_global_state(tmp_path):
    code = """
import logging, os, random, warnings
import numpy as np, torch
def state():
    return (torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled(), torch.get_default_device(),
            torch.are_deterministic_algorithms_enabled(), torch.get_float32_matmul_precision(), torch.get_rng_state(),
            np.random.get_state()[1], random.getstate(), np.geterr(), dict(os.environ), logging.root.handlers[:],
            logging.root.level, os.getcwd())
before = state()
import torchgrasp
for a, b in zip(before, state(), strict=True):
    same = a == b
    assert same if isinstance(same, bool) else bool(same.all()), (a, b)
print("same")
"""
    assert run(code, tmp_path) == "same\n"
    assert list(tmp_path.iterdir()) == []


def test_every_public_name_exists():
    import torchgrasp

    assert [name for name in torchgrasp.__all__ if not hasattr(torchgrasp, name)] == []


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_source_has_no_neural_network_pickle_or_global_random_state(path):
    text = path.read_text()
    forbidden = {
        "torch.nn": r"\btorch\.nn\b(?!_)|\bfrom torch import nn\b",
        "pickle": r"\bimport pickle\b|\bfrom pickle\b|\btorch\.load\(|allow_pickle=True",
        "global random state": r"\btorch\.manual_seed\(|\bnp\.random\.(seed|rand|randn|normal|uniform|choice)\(",
        "postponed annotations": r"^from __future__ import annotations",
    }
    found = [name for name, pattern in forbidden.items() if re.search(pattern, text, re.MULTILINE)]
    assert found == []
