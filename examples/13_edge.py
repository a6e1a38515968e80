"""A low object: the hand drags it over the edge of the table, and pinches the part that hangs over."""

import torch
import trimesh

from torchgrasp import ContactSpec, Plane, TrialSpec, load_hand, plan_edge_grasps
from torchgrasp.cloud import look_at, partial_view
from torchgrasp.evaluation import lift_from_edge

# A box of 10 mm height, seen from one side. The table ends 0.15 m from its middle, along x.
box = trimesh.creation.box([0.12, 0.06, 0.01]).apply_translation([0.0, 0.0, 0.005])
cloud = partial_view(box, look_at(azimuth=-135.0, elevation=40.0, target=box))
x = torch.tensor([1.0, 0.0, 0.0])
table = Plane.horizontal(0.0).ending(0.15 * x, outward=x)

hand = load_hand("barrett")
plan = plan_edge_grasps(cloud, hand, ContactSpec(table=table), starts=100, table_friction=0.3)
drag = plan.drag
if drag is not None:
    fingers = [name for name, k in zip(hand.finger_names, drag.presses, strict=True) if k]
    print(f"press with {' and '.join(fingers)}, together {drag.force:.1f} N")
    print(f"drag by {drag.displacement.numpy().round(3)} m, then let go")
print(f"pinch at the edge: predicted success {plan.grasps.best.success:.0%}")

# Only the simulator knows the true box. A table is more slippery than fingertips.
lift = lift_from_edge(plan, hand, box, TrialSpec(table_friction=0.3))
if lift.drag is not None:
    print(f"dragged: {lift.drag.status.name}, {1e3 * lift.drag.missed:.0f} mm beside the plan")
print(f"held: {lift.held}")
