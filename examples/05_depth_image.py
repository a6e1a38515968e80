"""From one depth image of a table to joint commands: what the camera measured goes in, a trajectory
comes out.
"""

import numpy as np
import torch

from torchgrasp import Scene, Status, load_hand, load_scene, plan_grasps
from torchgrasp.control import squeeze

shipped = load_scene()  # your own camera: depth in metres or uint16 mm, (fx, fy, cx, cy), its pose
depth = shipped.image.depth.numpy()
intrinsics = shipped.image.intrinsics.numpy()
scene = Scene.from_depth(
    np.round(1e3 * depth).astype(np.uint16),
    intrinsics,
    shipped.image.obj_from_camera.numpy(),
    point=(394, 312),
)
print(f"things {scene.things}, target {scene.target}, table {scene.table}")
for sentence in scene.advice:
    print("note:", sentence)


def reachable(obj_from_hand):
    """Stand in for the inverse kinematics of your arm: the palm must be within 0.9 m of its base."""
    return torch.linalg.vector_norm(obj_from_hand[:, :3, 3], dim=-1) < 0.9


hand = load_hand("allegro")
grasps = plan_grasps(scene, hand, starts=100, reachable=reachable)
best = grasps[0]
print(Status(int(best.status)).sentence, f"- predicted success {float(best.success):.0%}")

pose = best.obj_from_hand[0]
approach = best.approach[0]
start = pose.clone()
start[:3, 3] -= 0.1 * approach
print(
    "open, the palm to",
    start[:3, 3].numpy().round(3),
    "then straight to",
    pose[:3, 3].numpy().round(3),
)
for name, joints in {
    "pre-grasp": best.pregrasp[0],
    "grasp": best.joints[0],
    "squeeze": squeeze(hand, best, force=4.0).joints[0],
}.items():
    print(name, dict(zip(hand.joint_names, joints.numpy().round(3).tolist(), strict=True)))
