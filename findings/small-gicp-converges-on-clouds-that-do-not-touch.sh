#!/usr/bin/env bash
# small_gicp: two clouds a metre apart are registered at once: converged, after 0 iterations, with error 0 and no inlier.
# The pose is the initial guess. Only num_inliers tells it from a perfect result.
# Packages: small-gicp 1.0.1, numpy 2.4.6; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check small-gicp==1.0.1 numpy==2.4.6
cat > "$place/try.py" << 'END'
from importlib.metadata import version

import numpy as np
import small_gicp

draw = np.random.default_rng(0)
box = draw.uniform(-1, 1, (4000, 3))
side = draw.integers(0, 3, 4000)
box[np.arange(4000), side] = np.sign(box[np.arange(4000), side])
box *= [0.03, 0.04, 0.06]  # [m]
one, other = box[::2], box[1::2]
print("small-gicp", version("small-gicp"))
for kind in ("ICP", "PLANE_ICP", "GICP"):
    for apart in (0.0, 1.0):
        found = small_gicp.align(
            one + [apart, 0, 0],
            other,
            registration_type=kind,
            downsampling_resolution=0.002,
            max_correspondence_distance=0.02,
        )
        moved = float(np.abs(found.T_target_source - np.eye(4)).max())
        print(kind, f"{apart} m apart: converged {found.converged}, inliers {found.num_inliers}, error {found.error:.4g}")
        assert found.converged
        if apart:
            assert (found.num_inliers, found.error, moved) == (0, 0.0, 0.0)
        else:
            assert found.num_inliers > 1000 and found.error > 0
END
"$place/bin/python" "$place/try.py"
