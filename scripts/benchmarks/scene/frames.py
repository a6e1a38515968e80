"""Grasps and trials in random frames: cloud, camera, table and true mesh are moved together."""

import math

import torch
from torch import Tensor

from benchmarks.common import Options, Row, bench
from torchgrasp import ContactSpec, close_hand, list_objects, load_hand, load_object, plan_grasps
from torchgrasp.base import named_tensors
from torchgrasp.geometry.frames import inverse, rigid, rotation_from_vector
from torchgrasp.geometry.plane import Plane, move

STARTS = 25
"""Starts of each plan: fewer grasps to compare cost nothing in sharpness, as all stages run."""


@bench("scene/frames")
def frames(o: Options) -> list[Row]:
    """Return the largest differences of grasps in random frames, and of closings in some of them."""
    count, trials = o.times(200), o.times(20)
    generator, hand = torch.Generator().manual_seed(o.seed), load_hand(o.hands[0])
    grasp_error = trial_error = 0.0
    same = closed = done = 0
    for name in list_objects():
        known = load_object(name)
        view, table = known.view.to(torch.float64), Plane.horizontal(0.0)
        here = plan_grasps(view, hand, ContactSpec(table=table), STARTS)
        reference = close_hand(here[0], hand, known.mesh, parts=known.parts, table=table)
        for k in range(math.ceil(count / len(list_objects()))):
            pose = random_pose(generator)
            there = plan_grasps(move(view, pose), hand, ContactSpec(table=table.moved(pose)), STARTS)
            grasp_error = max(grasp_error, _difference(move(there, inverse(pose)), here))
            done += 1
            if k < trials // len(list_objects()):
                mesh, parts = (
                    [m.copy().apply_transform(pose.numpy()) for m in ms] for ms in ([known.mesh], known.parts)
                )
                closure = close_hand(there[0], hand, mesh[0], parts=parts, table=table.moved(pose))
                motion = torch.tensor([closure.object_motion]) - torch.tensor([reference.object_motion])
                forces = closure.forces[-1] - reference.forces[-1]
                trial_error = max(trial_error, float(motion.abs().max()), float(forces.abs().max()))
                same, closed = same + (closure.status is reference.status), closed + 1
    return [
        Row(
            f"grasps in {done} random frames, all numbers of all grasps",
            "the same to 1e-6",
            f"largest difference {grasp_error:.1e}",
            grasp_error <= 1e-6,
            {"frames": done, "difference": grasp_error},
        ),
        Row(
            f"closings in {closed} random frames: verdict; motion [m, rad] and last forces [N]",
            "equal",
            f"{same} of {closed} verdicts the same, largest difference {trial_error:.1e}",
            same == closed and trial_error <= 1e-6,
            {"frames": closed, "same": same, "difference": trial_error},
        ),
    ]


def random_pose(generator: torch.Generator) -> Tensor:
    """Return a random rotation with a translation of about a metre."""
    turn, shift = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    return rigid(rotation_from_vector(3 * turn), shift)


def _difference(a: object, b: object) -> float:
    """Return the largest difference of the tensors of two batches, infinite for another number of rows."""
    first, second = named_tensors(a), named_tensors(b)  # pyright: ignore[reportArgumentType]
    if any(first[name].shape != second[name].shape for name in second):
        return math.inf
    return max(float((first[name].double() - second[name].double()).abs().max()) for name in second)
