"""Gradients: fit the posture model, and move fingertips onto an uncertain shape, by descent."""

import torch

from torchgrasp import (
    GraspMixture,
    encode,
    fit_mixture,
    fit_shape,
    load_hand,
    load_mixture,
    load_object,
    plan_grasps,
    sample_configurations,
)
from torchgrasp.geometry.frames import apply, rotate

hand = load_hand("barrett")

# 1. The leaves are the parameters of four Gaussians in units of the samples' deviations.
samples = sample_configurations(hand, 3000)
rows = samples.rows()
em = fit_mixture(samples, components=4)
centre = rows.mean(0)
unit = rows.std(0)
logits = torch.zeros(4)
means = torch.randn(4, 10, generator=torch.Generator().manual_seed(0))
factors = torch.eye(10)
leaves = [x.double().requires_grad_() for x in (logits, means, factors.repeat(4, 1, 1))]
optimiser = torch.optim.Adam(leaves, lr=0.05)
for _ in range(300):
    logits, means, factors = leaves
    root = unit[:, None] * factors.tril()
    covariances = root @ root.mT + torch.diag(1e-4 * unit**2)
    model = GraspMixture(logits.softmax(0), centre + unit * means, covariances, em.names)
    loss = -model.log_prob(rows).mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
print(f"mean log-likelihood by descent {-loss:.2f}, by EM {em.log_prob(rows).mean():.2f}")

# 2. Kinematics, the shape's posterior and the posture model form one loss of the joints [rad].
view = load_object("cylinder").view
shape = fit_shape(view)
model = load_mixture("barrett")
grasp = plan_grasps(view, hand, starts=30)[0]
pose = grasp.obj_from_hand.double()
# spoiled, so that there is something to do
joints = (grasp.joints + 0.05).double()


def loss_of(joints: torch.Tensor) -> torch.Tensor:
    """Return squared distances and deviations [mm2] at the fingertips, plus Eq. (21)."""
    points, normals = hand.fingertips(joints)
    points = apply(pose, points)
    normals = rotate(pose, normals)
    surface = shape.predict(points)
    off = 1e3 * shape.scale * surface.distance  # [mm]
    energy = model.energy(encode((points, normals))).amin()
    return (off**2 + (1e3 * surface.std_m) ** 2).sum() + energy


print(f"loss {float(loss_of(joints)):.1f} of the spoiled grasp,", end=" ")
joints.requires_grad_()
optimiser = torch.optim.LBFGS([joints], max_iter=25, line_search_fn="strong_wolfe")


def evaluate() -> torch.Tensor:
    """Return the loss, and leave its gradient in the joints."""
    optimiser.zero_grad()
    loss = loss_of(joints)
    loss.backward()
    return loss


optimiser.step(evaluate)
joints = joints.detach()
curvature = torch.func.hessian(loss_of)(joints)[0, :, 0]
bends = torch.linalg.eigvalsh(curvature).numpy().round()
print(f"{float(loss_of(joints)):.1f} after descent, with curvatures {bends}")
