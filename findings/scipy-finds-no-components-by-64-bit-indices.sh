#!/usr/bin/env bash
# SciPy 1.11: connected_components finds 0 components, all labelled -9999, where a sparse array has 64-bit indices.
# No exception is raised; a note goes to stderr. coo_array keeps the indices of numpy.nonzero, coo_matrix makes them 32-bit.
# Packages: scipy 1.11.1 and 1.12.0 (mended), numpy 1.26.4; Python 3.10 or 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
cat > "$place/try.py" << 'END'
import numpy as np
import scipy
from scipy.sparse import coo_array, coo_matrix
from scipy.sparse.csgraph import connected_components

start, end = np.array([0, 1, 3]), np.array([1, 2, 4])  # two chains and a lone node
ones = np.ones(3)
found = {}
for kind in (coo_array, coo_matrix):
    for bits in (np.int32, np.int64):
        graph = kind((ones, (start.astype(bits), end.astype(bits))), shape=(6, 6))
        count, labels = connected_components(graph, directed=False)
        found[kind.__name__, bits.__name__] = int(count)
        print("scipy", scipy.__version__, kind.__name__, bits.__name__, count, labels.tolist())
wrong = [key for key, count in found.items() if count != 3]
expected = [("coo_array", "int64")] if scipy.__version__ == "1.11.1" else []
assert wrong == expected, wrong
assert all(found[key] == 0 for key in wrong)
END
for version in 1.11.1 1.12.0; do
    "$place/bin/python" -m pip install -qq --disable-pip-version-check scipy==$version numpy==1.26.4
    "$place/bin/python" "$place/try.py" 2> "$place/stderr"
done
