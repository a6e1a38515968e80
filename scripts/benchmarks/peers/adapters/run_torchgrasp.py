"""Our own planner with its defaults, the table known: from one noisy view."""

import time

import numpy as np
import torch
import trimesh
from messages import find_versions, print_answer, read_task

from torchgrasp import ContactSpec, PointCloud, Status, load_hand, plan_grasps
from torchgrasp.export.postures import describe_pose

POINTS = 1000
"""Points that are drawn on the whole surface."""


def main(whole: bool = False) -> None:
    """Plan, and print the executable grasps; `whole` plans on points of the whole true surface."""
    torch.set_num_threads(1)
    task = read_task()
    hand = load_hand("allegro")
    if whole:
        mesh = trimesh.load_mesh(task["mesh"])
        points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=task["seed"])
        normals = torch.tensor(mesh.face_normals[faces])
        cloud = PointCloud(torch.tensor(np.asarray(points)), normals)
    else:
        camera = torch.tensor(task["camera"], dtype=torch.float64)
        cloud = PointCloud(torch.tensor(np.loadtxt(task["view"])), viewpoint=camera)
    spec = ContactSpec(friction=task["friction"], table=0.0)
    began = time.process_time()
    grasps = plan_grasps(cloud, hand, spec, task["starts"], task["seed"])
    seconds = time.process_time() - began
    found = []
    for row in torch.nonzero(grasps.status == Status.OK)[:, 0].tolist():
        joints = hand.expand(grasps.joints[row])
        numbers = [float(joints[name]) for name in hand.joint_names]
        found.append(describe_grasp(numbers, grasps.obj_from_hand[row]))
    print_answer(
        fingers="default",
        sees="mesh" if whole else "view",
        settings="defaults",
        versions=find_versions("torchgrasp", "torch"),
        tried=task["starts"],
        seconds=seconds,
        joint_names=hand.joint_names,
        grasps=found,
    )


def describe_grasp(joints: list[float], pose: torch.Tensor) -> dict[str, list[float]]:
    """Return joints and pose (4, 4) [m] of a grasp as an answer has them."""
    told = describe_pose(pose)
    return {"joints": joints, "pose": [*told["position"], *told["quaternion_wxyz"]]}


if __name__ == "__main__":
    main()
