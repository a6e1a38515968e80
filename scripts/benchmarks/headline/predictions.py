"""Whether predicted success is true for pulls at the left-out objects."""

import dataclasses

from paper.trials import CELL_SECONDS, subjects

from benchmarks.close.campaign import table_spec
from benchmarks.close.success import (
    FRICTIONS,
    MASSES,
    Cell,
    judge_order,
    judge_predictions,
    judge_promise,
    try_object,
)
from benchmarks.common import Options, Row, bench, run_all
from benchmarks.headline.left_out import LEFT_OUT


@bench("headline/pulls", objects=True)
def pulls(o: Options) -> list[Row]:
    """Pull at grasps of the Allegro hand, each object at one friction and mass: they take turns."""
    o = dataclasses.replace(o, names=o.names or LEFT_OUT, hands=("allegro",))
    spec = dataclasses.replace(table_spec(o), representatives=False)
    tasks = [
        (spec, x, "allegro", FRICTIONS[k % 3], MASSES[k // 3 % 3], "mujoco")
        for k, x in enumerate(subjects(spec))
    ]
    cells = [Cell(*found) for found in run_all(try_object, tasks, spec.workers, CELL_SECONDS)]
    planned = [cell for cell in cells if cell.tried]
    rows = [Row("views with an executable grasp", "-", f"{len(planned)} of {len(cells)}")]
    if planned:
        rows += judge_predictions(planned) + judge_order(planned) + judge_promise(planned)
    return rows
