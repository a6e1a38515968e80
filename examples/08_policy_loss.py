"""A loss for a policy: how far its fingertip contacts are from force closure, with a gradient for
every contact.

A policy in Isaac Lab or ManiSkill returns fingertip positions on the object. Their closure margin
is a dense reward. Its gradient tells the policy how to move each contact. Here random contacts on a
sphere take the policy's place.
"""

import torch

from torchgrasp import Contacts, ContactSpec, certify

radius = 0.04
spec = ContactSpec(friction=0.6, friction_margin=1.0)


def margin_of(actions: torch.Tensor) -> torch.Tensor:
    """Return the closure margin of contacts (b, 3) in the directions `actions` from the centre of a
    sphere.
    """
    normals = torch.nn.functional.normalize(actions, dim=-1)
    return certify(Contacts(radius * normals, normals), spec).margin


actions = torch.randn(64, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
for step in range(0, 61):
    actions.requires_grad_()
    margin = margin_of(actions)
    known = torch.isfinite(
        margin
    )  # -inf: the forces do not balance, and the margin has no gradient
    (gradient,) = torch.autograd.grad(margin[known].sum(), actions)
    if step % 20 == 0:
        closed = int((margin > 1e-6).sum())
        mean = float(margin[known].detach().mean())
        print(
            f"step {step}: {closed} of 64 contact sets have force closure, mean margin {mean:.4f}"
        )
    actions = actions.detach() + 0.5 * torch.where(known[:, None, None], gradient, 0.0)
