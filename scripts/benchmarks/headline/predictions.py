"""Whether predicted success is true for pulls at the left-out objects."""

import dataclasses

from paper.trials import subjects

from benchmarks.close.success import FRICTIONS, MASSES, judge_tasks, table_spec
from benchmarks.common import Options, Row, bench
from benchmarks.headline.left_out import LEFT_OUT


@bench("headline/pulls", objects=True)
def pulls(o: Options) -> list[Row]:
    """Pull at grasps of the Allegro hand, each object at one friction and mass: they take turns."""
    spec = table_spec(dataclasses.replace(o, names=o.names or LEFT_OUT), representatives=False)
    tasks = [
        (spec, x, "allegro", FRICTIONS[k % 3], MASSES[k // 3 % 3], "mujoco")
        for k, x in enumerate(subjects(spec))
    ]
    return judge_tasks(tasks, o.workers)
