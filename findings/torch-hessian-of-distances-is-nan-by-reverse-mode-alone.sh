#!/usr/bin/env bash
# torch: the Hessian of a thin-plate kernel r^3 by points, whose matrix of distances has zeros on its diagonal, depends on the
# mode. The gradient is right. Forward over reverse (torch.func.hessian) and forward over forward are right, to 1e-6 of
# differences. Reverse over reverse (double backward) and reverse over forward give NaN in all entries, without a warning.
# torch.linalg.vector_norm counts as constant at zero in its first derivative, and not in the derivative of that.
# torch.cdist has no second derivative at all, and says so.
# Packages: torch 2.13.0 (any build), numpy 2.4.6; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check torch==2.13.0 numpy==2.4.6
cat > "$place/try.py" << 'END'
import torch
from torch.func import grad, hessian, jacfwd, jacrev

torch.manual_seed(0)
points = torch.randn(4, 3, dtype=torch.float64)


def energy(x):
    return (torch.linalg.vector_norm(x[:, None] - x[None], dim=-1) ** 3).sum()


step = 1e-5
columns = []
for k in range(points.numel()):
    move = torch.zeros(points.numel(), dtype=torch.float64)
    move[k] = step
    move = move.view_as(points)
    columns.append((grad(energy)(points + move) - grad(energy)(points - move)) / (2 * step))
true = torch.stack(columns, -1).view(4, 3, 4, 3)
print("torch", torch.__version__, "gradient finite:", bool(grad(energy)(points).isfinite().all()))
ways = {
    "torch.func.hessian": hessian(energy),
    "forward over forward": jacfwd(jacfwd(energy)),
    "reverse over reverse": jacrev(jacrev(energy)),
    "reverse over forward": jacrev(jacfwd(energy)),
}
for name, way in ways.items():
    found = way(points)
    wrong = int(found.isnan().sum())
    error = float((found - true).abs().max())
    print(f"{name:21} {wrong} of {found.numel()} entries are NaN, largest error {error:.1e}")
    if name.startswith("reverse"):
        assert wrong == found.numel()
    else:
        assert wrong == 0 and error < 1e-6 * float(true.abs().max())
leaf = points.clone().requires_grad_()
(first,) = torch.autograd.grad(energy(leaf), leaf, create_graph=True)
(second,) = torch.autograd.grad(first.sum(), leaf)
print("double backward: NaN in", int(second.isnan().sum()), "of", second.numel())
assert bool(second.isnan().all())
leaf = points.clone().requires_grad_()
(first,) = torch.autograd.grad((torch.cdist(leaf, leaf) ** 3).sum(), leaf, create_graph=True)
try:
    torch.autograd.grad(first.sum(), leaf)
except RuntimeError as error:
    print("cdist:", error)
else:
    raise SystemExit("cdist has a second derivative now")
END
"$place/bin/python" "$place/try.py"
