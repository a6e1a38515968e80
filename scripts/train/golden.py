"""`scripts/train.py golden`: the shipped grasps with known verdicts."""

from torchgrasp import ContactSpec, load_hand, load_object, plan_grasps
from torchgrasp.data.shipped import DATA
from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.golden import GOLDEN, run_golden
from torchgrasp.specs import Simulator

SIMULATORS: tuple[Simulator, ...] = ("sapien", "mujoco")


def golden(seed: int = 0) -> None:
    """Plan the grasps of the golden set, and refuse a set whose verdicts are not the expected ones.

    Args:
        seed: of the plans.
    """
    for name, hand_name in sorted({(case.object, case.hand) for case in GOLDEN}):
        hand = load_hand(hand_name)
        grasps = plan_grasps(load_object(name).view, hand, ContactSpec(table=0.0), starts=300, seed=seed)
        grasps[grasps.status == Status.OK][0].save(DATA / name / f"{hand_name}.safetensors")
    for simulator in SIMULATORS:
        for result in run_golden(simulator):
            print(simulator, result)
            if not result.right:
                raise BadArgument("seed", f"{seed}: {result.case} is wrong in {simulator}", "one with right verdicts")
