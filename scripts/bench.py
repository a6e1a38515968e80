#!/usr/bin/env python
"""Measure torchgrasp: python scripts/bench.py SUBJECT [--only BENCH ...] [--objects DIR] [options].

close  misplaced, sensors, perturb, table-lift, holding, play, speed, success, arm, where: closing,
lifts, exports gpu    kernels, clouds, launches, pulls: kernels beside the CPU; many clouds and
trials at once; launches, without a GPU hand   fk, collision, codes, em: kinematics beside
pytorch-kinematics, self-collision, inverse kinematics, learning load   plans, trials, points,
starts, campaign, scheduler, waiting: memory over many plans and trials, of large inputs; what a
million views cost; Dask's scheduler with a thousand workers, some of which die, and with waiting
jobs plan   truth, fields, executable, certificates, wrenches, pace: contacts on the true surface,
proofs, time to grasps scene  plane, click, rooms, real, whole, clutter, clear: depth images, and
lifts among neighbours shape  objects, weaker: the estimated shape against true meshes

Each bench prints rows, and writes them as JSON and as a Markdown table with commit, machine and
command. Times are for a quiet machine; beside other work set OMP_WAIT_POLICY=PASSIVE.
"""

from collections.abc import Callable

import tyro
from benchmarks.common import Options, measure

SUBJECTS = ("close", "gpu", "hand", "load", "plan", "scene", "shape")


def command(subject: str) -> Callable[[Options], None]:
    """Return the command that runs the benches of a subject."""

    def run(options: tyro.conf.OmitArgPrefixes[Options]) -> None:
        measure(subject, options)

    run.__doc__ = f"Run benches of {subject}; see scripts/bench.py --help."
    return run


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {name: command(name) for name in SUBJECTS}, description=__doc__
    )
