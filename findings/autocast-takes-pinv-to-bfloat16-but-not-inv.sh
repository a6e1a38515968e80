#!/usr/bin/env bash
# torch.autocast on a CPU: linalg.pinv of a float32 Jacobian comes in bfloat16; inv, lstsq, svd and solve stay in float32.
# pinv multiplies matrices inside, and those products are cast. The pseudo-inverse of a 6 x 6 matrix is off by 0.5 %.
# Packages: torch 2.13.0 (any build), numpy 2.4.6; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check torch==2.13.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import torch

torch.manual_seed(0)
jacobian = torch.randn(6, 6)
step = torch.randn(6, 1)
ways = {
    "pinv": lambda: torch.linalg.pinv(jacobian),
    "inv": lambda: torch.linalg.inv(jacobian),
    "lstsq": lambda: torch.linalg.lstsq(jacobian, step)[0],
    "solve": lambda: torch.linalg.solve(jacobian, step),
    "svd": lambda: torch.linalg.svd(jacobian)[1],
    "vecdot": lambda: torch.linalg.vecdot(jacobian, jacobian),
    "vector_norm": lambda: torch.linalg.vector_norm(jacobian, dim=-1),
}
print("torch", torch.__version__)
low = set()
for name, way in ways.items():
    true = way()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = way()
    off = float((found.double() - true.double()).abs().max() / true.abs().max())
    print(f"{name:12} {found.dtype}, relative error {off:.1e}")
    if found.dtype == torch.bfloat16:
        low.add(name)
        assert off > 1e-4
    else:
        assert off < 1e-5
assert low == {"pinv", "vecdot"}, low
END
"$place/bin/python" "$place/try.py"
