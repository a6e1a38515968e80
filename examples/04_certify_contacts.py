"""Contacts of another planner: do they hold, how far from not holding are they, and can a hand take
them?
"""

import math

import torch

from torchgrasp import Contacts, ContactSpec, certify, load_hand, load_mixture, solve_ik

# Three contacts around a can of radius 33 mm, the third one opposite the first two. Then three on
# one side of it.
angles = (
    torch.tensor([[20.0, -20.0, 180.0], [40.0, 0.0, -40.0]], dtype=torch.float64) * math.pi / 180
)
normals = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], -1)
contacts = Contacts(
    points=0.033 * normals + torch.tensor([0.0, 0.0, 0.05], dtype=torch.float64), normals=normals
)

certificate = certify(contacts, ContactSpec(friction=0.6, friction_margin=1.0))
for closed, margin, witness in zip(
    certificate.closed, certificate.margin, certificate.witness, strict=True
):
    told = (
        f"closed, margin {float(margin):.4f}"
        if closed
        else f"not closed: nothing opposes {witness.numpy().round(2)}"
    )
    print(told)

hand = load_hand("allegro")
solution = solve_ik(hand, contacts, load_mixture("allegro"))
print(solution.status, (1e3 * solution.tip_error).round(decimals=2))
