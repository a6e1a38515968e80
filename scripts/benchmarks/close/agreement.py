"""Whether two simulators judge the same grasps alike: under published pulls, and in lifts with the controller."""

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.metrics import cohen_kappa_score, confusion_matrix

from benchmarks.common import Options, Row, bench
from torchgrasp import load_hand
from torchgrasp.evaluation import EvaluationSpec, evaluate
from torchgrasp.evaluation.intervals import count_by, format_share, share_over
from torchgrasp.evaluation.protocols import PROTOCOLS
from torchgrasp.evaluation.score import ProtocolResult, ViewScore

TESTS = ("dexgraspbench", "dexgraspbench-hard", "pose-noise", "paper")
"""Three that pull and one that lifts, the last two with an error of where hand or object stand."""

SIMULATORS = ("sapien", "mujoco")

BAR = 0.93
"""Least share of equal verdicts."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One grasp in one test, in both simulators."""

    test: str
    hand: str
    view: ViewScore
    sapien: ProtocolResult
    mujoco: ProtocolResult

    @property
    def verdicts(self) -> "Verdicts":
        """Return whether it passed in SAPIEN and in MuJoCo."""
        return self.view.unit, self.sapien.passed, self.mujoco.passed


Verdicts = tuple[str, bool, bool]
"""The family of an object, and whether a grasp passed in SAPIEN and in MuJoCo."""


@bench("close/agreement", objects=True)
def agreement(o: Options) -> list[Row]:
    """Put grasps of all ranks of every view of every object to each test."""
    objects, workers = o.objects[0], o.workers
    spec = EvaluationSpec(o.grasps, "spread", o.starts, only=o.names, seed=o.seed)
    cases = []
    for hand in map(load_hand, o.hands):
        with tempfile.TemporaryDirectory() as folder:
            planned = False
            for test in TESTS:
                protocol = PROTOCOLS[test]
                protocol = dataclasses.replace(protocol, noise=dataclasses.replace(protocol.noise, draws=1))
                scores = []
                for simulator in SIMULATORS:
                    run, asked = protocol.with_trial(simulator=simulator), dataclasses.replace(spec, planned=planned)
                    scores.append(list(evaluate(objects, hand, run, asked, folder=Path(folder), workers=workers)))
                    planned = True
                for there, here in zip(*scores, strict=True):
                    pairs = zip(there.attempts, here.attempts, strict=True)
                    cases += [Case(test, hand.name, there, *pair) for pair in pairs]
    rows = [_case_row(test, [case for case in cases if case.test == test]) for test in TESTS]
    return [*rows, _case_row(f"all tests, {spec.tried}", cases), speed_row(cases)]


def _case_row(test: str, cases: list[Case]) -> Row:
    """Return the agreement of cases, with what there is to know of those that are judged unequally."""
    row = agreement_row(test, [case.verdicts for case in cases])
    unequal = [_unequal(case) for case in cases if case.sapien.passed != case.mujoco.passed]
    return dataclasses.replace(row, numbers=row.numbers | {"unequal": unequal})


def agreement_row(test: str, verdicts: list[Verdicts]) -> Row:
    """Return the share of equal verdicts, and which way the others went."""
    both = [[sapien for _, sapien, _ in verdicts], [mujoco for *_, mujoco in verdicts]]
    labels = [True, False]
    table, kappa = confusion_matrix(*both, labels=labels), float(cohen_kappa_score(*both, labels=labels))
    found = share_over(count_by((family, sapien == mujoco) for family, sapien, mujoco in verdicts))
    measured = (
        f"{format_share(found)} of {len(verdicts)}, kappa {kappa:.2f}; both pass {table[0, 0]}, "
        f"both fail {table[1, 1]}, SAPIEN alone passes {table[0, 1]}, MuJoCo alone {table[1, 0]}"
    )
    numbers = {"share": found, "table": table.tolist(), "kappa": kappa}
    return Row(f"agreement of SAPIEN and MuJoCo, {test}", f">= {BAR:.0%}", measured, found.value >= BAR, numbers)


def _unequal(case: Case) -> dict[str, Any]:
    """Return what there is to know of a grasp that is judged unequally."""
    known = {"test": case.test, "hand": case.hand, "object": case.view.object, "view": case.view.view}
    for name in SIMULATORS:
        attempt = getattr(case, name)
        known[name] = dataclasses.asdict(attempt) | {"status": attempt.status.name}
    return known


def speed_row(cases: list[Case]) -> Row:
    """Return the mean CPU time of an attempt in either simulator, where both ran to the end."""
    numbers = {}
    for test in TESTS:
        both = [c for c in cases if c.test == test and c.sapien.passed and c.mujoco.passed]
        numbers[test] = [float(np.mean([getattr(c, s).seconds for c in both])) for s in SIMULATORS] if both else []
    measured = ", ".join(f"{test} {' / '.join(f'{x:.2f}' for x in pair)} s" for test, pair in numbers.items())
    return Row("CPU time of an attempt that passes, SAPIEN / MuJoCo", "-", measured, None, numbers)
