"""FRoGGeR (github.com/alberthli/frogger) with the settings of its published Allegro example.

Written after its README and its example; it runs where that package is installed, which the index
of Python packages does not have: `frogger` there is a program that reads text aloud.
"""

import sys
import time

from messages import JOINTS, find_versions, print_answer, read_task

FINGERS = ("if", "mf", "rf", "th")
TIPS = (0.0267, 0.0267, 0.0267, 0.0423)
"""FRoGGeR's names of the fingers, and heights [m] of the tips' spheres in their last links."""


def main() -> None:
    """Generate grasps until the time is spent, and print them."""
    task = read_task()
    try:
        import numpy as np
        import trimesh
        from frogger.objects import MeshObjectConfig  # pyright: ignore[reportMissingImports]
        from frogger.robots.robots import (  # pyright: ignore[reportMissingImports]
            AlgrModelConfig,
        )
        from frogger.sampling import (  # pyright: ignore[reportMissingImports]
            HeuristicAlgrICSampler,
        )
        from frogger.solvers import FroggerConfig  # pyright: ignore[reportMissingImports]
        from pydrake.math import RigidTransform  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        sys.exit(f"no FRoGGeR in this environment: {error}")
    np.random.seed(task["seed"])  # noqa: NPY002 -- its sampler draws from this generator
    began = time.process_time()
    mesh = trimesh.load(task["mesh"])
    at = RigidTransform()
    thing = MeshObjectConfig(X_WO=at, mesh=mesh, name="peer", clean=False).create()
    model = AlgrModelConfig(
        obj=thing, ns=4, mu=0.7, d_min=0.001, d_pen=0.005, l_bar_cutoff=0.3, hand="rh"
    ).create()
    solver = FroggerConfig(
        model=model,
        sampler=HeuristicAlgrICSampler(model),
        tol_surf=1e-3,
        tol_joint=1e-2,
        tol_col=1e-3,
        tol_fclosure=1e-5,
        xtol_rel=1e-6,
        xtol_abs=1e-6,
        maxeval=1000,
        maxtime=60.0,
    ).create()
    grasps = []
    while time.process_time() - began < task["seconds"]:
        model.compute_all(solver.generate_grasp())
        grasps.append(describe(model))
    print_answer(
        fingers="four",
        sees="mesh",
        settings="its published example; starts that fail are repeated inside it, and not counted",
        versions=find_versions("frogger", "drake", "nlopt"),
        tried=len(grasps),
        seconds=time.process_time() - began,
        joint_names=JOINTS,
        grasps=grasps,
    )


def describe(model) -> dict[str, list]:
    """Return joints and fingertips of the model's present grasp."""
    plant = model.plant
    context = model.plant_context
    joints = []
    tips = []
    for finger, height in zip(FINGERS, TIPS, strict=True):
        # the joints of a finger in the order of their names, which end in their number
        own = [
            plant.get_joint(index)
            for index in plant.GetJointIndices()
            if f"_{finger}_" in plant.get_joint(index).name()
            and plant.get_joint(index).num_positions() == 1
        ]
        own.sort(key=lambda joint: joint.name())
        joints += [joint.GetOnePosition(context) for joint in own]
        frame = plant.GetFrameByName(f"algr_rh_{finger}_ds")
        place = plant.CalcPointsPositions(context, frame, [0.0, 0.0, height], plant.world_frame())
        tips.append([float(x) for x in place.ravel()])
    return {"joints": [float(x) for x in joints], "tips": tips}


if __name__ == "__main__":
    main()
