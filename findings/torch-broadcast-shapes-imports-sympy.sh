#!/usr/bin/env bash
# torch.broadcast_shapes, which only compares tuples of integers, imports SymPy and some 480 other modules at its first call.
# That takes hundreds of milliseconds, thousands of times as long as later calls. In a loop with a fixed period the first
# tick is late. torch.broadcast_tensors and numpy.broadcast_shapes give the same shape, and import nothing.
# Packages: torch 2.13.0 (any build), numpy 2.4.6; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check torch==2.13.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import sys
import time

import numpy as np
import torch


def watch(what, call):
    """Return the shape, the number of imported modules and the CPU seconds of a call."""
    before = set(sys.modules)
    began = time.process_time()
    shape = tuple(call())
    spent = time.process_time() - began
    new = set(sys.modules) - before
    print(f"{what:26} {shape}, {1e3 * spent:8.3f} ms, {len(new)} modules, SymPy: {'sympy' in new}")
    return shape, new, spent


print("torch", torch.__version__)
assert "sympy" not in sys.modules
one, other = (3, 1), (1, 4)
tensors = torch.zeros(one), torch.zeros(other)
watch("broadcast_tensors", lambda: torch.broadcast_tensors(*tensors)[0].shape)
numpy_shape, numpy_new, _ = watch("numpy.broadcast_shapes", lambda: np.broadcast_shapes(one, other))
shape, new, first = watch("broadcast_shapes, first", lambda: torch.broadcast_shapes(one, other))
_, none, later = watch("broadcast_shapes, later", lambda: torch.broadcast_shapes(one, other))
assert shape == numpy_shape == (3, 4)
assert "sympy" in new and len(new) > 300 and not none and "sympy" not in numpy_new
assert first > 100 * later
END
"$place/bin/python" "$place/try.py"
