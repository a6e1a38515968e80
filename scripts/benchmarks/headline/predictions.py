"""Whether predicted success is true for pulls at the left-out objects, and what a region costs."""

import dataclasses

from paper.trials import subjects

from benchmarks.close.campaign import run_all, table_spec
from benchmarks.close.success import (
    FRICTIONS,
    MASSES,
    Cell,
    judge_order,
    judge_predictions,
    judge_promise,
    try_object,
)
from benchmarks.close.where import where
from benchmarks.common import Options, Row, bench
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
    cells = [Cell(*found) for found in run_all(try_object, tasks, spec.workers)]
    planned = [cell for cell in cells if cell.tried]
    rows = [Row("views with an executable grasp", "-", f"{len(planned)} of {len(cells)}")]
    if planned:
        rows += judge_predictions(planned) + judge_order(planned) + judge_promise(planned)
    return rows


@bench("headline/region", objects=True)
def region(o: Options) -> list[Row]:
    """Close the best grasp of a free plan and of one in a region, one object of each family."""
    return where(dataclasses.replace(o, names=o.names or LEFT_OUT, hands=("allegro", "barrett")))
