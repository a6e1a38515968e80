#!/usr/bin/env python
"""Make the files that torchgrasp ships: learned models, and the library's own objects.

`torchgrasp hand train` learns the posture model of a hand.

* paper_model HAND: the posture model of mode "paper"
* success: the predicted success that ranks grasps
* promise DIR: trials on further families that support its promises
* judge_fresh DIR: how well it predicts later trials, to which its range may be widened
* occupancy DIR: how likely hidden places of a scene are full
* bands DIR: how far off hidden sides are
* household DIR: bodies of a household, with views, for any bench
* trials DIR: grasps on these bodies, each tried with its own task
* objects: meshes, convex parts and views of the own objects
* golden: grasps with known verdicts, for torchgrasp selftest
"""

import sys

import tyro
from train.author_objects import golden, objects
from train.bands import bands
from train.household import household
from train.occupancy import occupancy
from train.paper_model import paper_model
from train.success import judge_fresh, promise, success
from train.trials import trials

from torchgrasp.foundation.errors import GraspError

if __name__ == "__main__":
    models = (paper_model, success, promise, judge_fresh, occupancy, bands)
    commands = {x.__name__: x for x in (*models, household, trials, objects, golden)}
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands, prog="train.py", description="Files that torchgrasp ships."
        )
    except GraspError as error:
        sys.exit(f"train.py: {error}")
