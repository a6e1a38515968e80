"""Runs the readers of other libraries in their own environment."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".beside" / "lerobot" / "bin" / "python"


def read_foreign(kind: str, folders: list[Path], tmp_path: Path) -> list[dict[str, Any]]:
    """Return what other libraries read in each folder, without a network and with an empty cache:
    they are loaded once.
    """
    if not PYTHON.exists():
        pytest.skip("scripts/beside lerobot makes the environment of the readers")
    out = tmp_path / "read.json"
    cache = {"HF_HOME": str(tmp_path / "cache"), "HF_HUB_OFFLINE": "1"}
    command = [
        str(PYTHON),
        str(Path(__file__).with_name("foreign.py")),
        kind,
        str(out),
        *map(str, folders),
    ]
    done = subprocess.run(
        command, env=os.environ | cache | {"PYTHONPATH": ""}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(out.read_text())
