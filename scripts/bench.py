#!/usr/bin/env python
"""Measure torchgrasp. Each command prints a table and writes the same numbers as JSON.

python scripts/bench.py anytime --objects DIR  how soon grasps come, and what waiting for more is worth
python scripts/bench.py close --objects DIR    closing the hand: the simulators against statics and against each other
python scripts/bench.py grasp --objects DIR    cloud to held object, for every object of a folder and both hands
python scripts/bench.py gpu                    every kernel on a GPU beside the CPU, where there is a GPU
python scripts/bench.py hand                   the hands: kinematics, collision, the learned model, contacts to postures
python scripts/bench.py load                   memory over many plans and trials in one process, and of large inputs
python scripts/bench.py plan --objects DIR     the contact planner against IPOPT, on the true surface, and as it grows
python scripts/bench.py proof --objects DIR    certificates and the probability of closure, against exact references
python scripts/bench.py scene --objects DIR    one depth image to its table, and to the thing at a clicked pixel
python scripts/bench.py shape --objects DIR    exactness, speed, memory and calibration of the shape, beside its bars

Times on two threads are for a quiet machine. Beside other work set OMP_WAIT_POLICY=PASSIVE: threads then sleep where
they would spin, which takes a plan twice as long on a quiet one.
"""

import tyro
from benchmarks.anytime.suite import anytime
from benchmarks.close.suite import close
from benchmarks.gpu.suite import gpu
from benchmarks.grasp.suite import grasp
from benchmarks.hand.suite import hand
from benchmarks.load.suite import load
from benchmarks.plan.suite import plan
from benchmarks.proof.suite import proof
from benchmarks.scene.suite import scene
from benchmarks.shape.suite import shape

if __name__ == "__main__":
    subjects = {
        "anytime": anytime,
        "close": close,
        "gpu": gpu,
        "grasp": grasp,
        "hand": hand,
        "load": load,
        "plan": plan,
        "proof": proof,
        "scene": scene,
        "shape": shape,
    }
    tyro.extras.subcommand_cli_from_dict(subjects)
