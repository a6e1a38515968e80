"""The parts of a whole reproduction: what each shows, which command makes it, how large it is, and what it takes."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from paper.fig4 import fig4
from paper.fig6 import fig6
from paper.fig9_to_12 import grasps
from paper.ladder import RUNGS, judge_ladder
from paper.rows import Cell, Row, TableSpec
from paper.table3 import table3
from paper.table4_fig5 import fig5, table4
from paper.table5_fig7_fig8 import fig7, fig8, table5
from paper.tables6_7 import ROWS6, ROWS7, judge_table6, judge_table7
from paper.trials import subjects

EVERY = 1000
"""More families than anyone has."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How large the parts are.

    Args:
        starts: of the contact planner in Table 4 and before every lift.
        drawn: starts behind Figs. 5 and 9 to 12.
        postures: held-out postures of Table 5, Figs. 7 and 8.
        fitted: postures of the criterion of Fig. 6.
        apart: postures of its cross-validation.
        folds: of its cross-validation.
        families: of objects from folders, one object each, beside the library's own four.
        grasps: lifted of each object and hand in Tables 6 and 7; of the ladder one.
        draws: lifts of each grasp.
    """

    starts: int = 1000
    drawn: int = 300
    postures: int = 100_000
    fitted: int = 40_000
    apart: int = 20_000
    folds: int = 10
    families: int = EVERY
    grasps: int = 3
    draws: int = 10


FULL = Sizes()
"""Every trial: three grasps and ten lifts of each, as in the paper, of one object of every family."""
QUICK = dataclasses.replace(FULL, postures=20_000, folds=3, families=8, grasps=2, draws=1)
"""What two cores do in some 20 minutes: fewer lifts, families, test postures and folds."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """What one command makes alone: a table, or pictures.

    `sizes` are its options and the fields of `Sizes` that they take. `numbers` tells whether it writes a JSON of its
    name. `seconds` is its processor time at quick sizes.
    """

    name: str
    title: str
    about: str
    make: Callable[..., None]
    seconds: float
    sizes: dict[str, str] = dataclasses.field(default_factory=dict)
    pictures: tuple[str, ...] = ()
    numbers: bool = True

    def options(self, sizes: Sizes) -> dict[str, Any]:
        """Return the options of the command."""
        return {option: getattr(sizes, field) for option, field in self.sizes.items()}


@dataclasses.dataclass(frozen=True)
class Trials:
    """A table of lifts. `seconds` is the processor time of an object with a hand at quick sizes."""

    name: str
    title: str
    about: str
    rows: tuple[Row, ...]
    judge: Callable[[TableSpec, Iterator[tuple[Cell, ...]]], None]
    seconds: float
    repeated: bool = True
    """Whether more than the best grasp is lifted, and more than once."""

    def spec(self, out: Path, objects: tuple[Path, ...], sizes: Sizes, workers: int) -> TableSpec:
        """Return what the table is made of."""
        spec = TableSpec(out, objects, representatives=True, starts=sizes.starts, workers=workers)
        found = subjects(spec)
        few = [x.name for x in found if x.folder is None] + [x.name for x in found if x.folder][: sizes.families]
        many = {"grasps": sizes.grasps, "draws": sizes.draws} if self.repeated else {"grasps": 1, "draws": 1}
        return dataclasses.replace(spec, only=tuple(few), **many)


FIGURES = (
    Figure(
        "table3", "Table 3", "Points that the filter keeps of 1000, and seconds of filter and shape. The paper has "
        "whole clouds alone; one view is what a camera sees.", table3, 5.0,
    ),
    Figure(
        "fig4", "Fig. 4", "Whole and partial clouds, and the shapes that follow from them.", fig4, 15.0,
        pictures=("fig4",), numbers=False,
    ),
    Figure(
        "table4", "Table 4", "Certified contact triples, the time of a start and the distance of their centre from "
        "the object's. S is the threshold of the variance, Eq. (12); closes is the mean probability of closure on the "
        "uncertain surface.", table4, 100.0, {"starts": "starts"},
    ),
    Figure(
        "fig5", "Fig. 5", "Planned contacts on the surface, coloured by its standard deviation: a column of the "
        "paper's problem and one of the default one for each object.", fig5, 25.0, {"starts": "drawn"}, ("fig5",),
        numbers=False,
    ),
    Figure(
        "fig6", "Fig. 6", "The number of Gaussians by the Bayesian information criterion and by cross-validation.",
        fig6, 190.0, {"n": "fitted", "apart": "apart", "folds": "folds"}, ("fig6",),
    ),
    Figure(
        "table5", "Table 5", "Mean absolute error [rad] of the joints of the Barrett hand that the learned model "
        "predicts, in four cases and over all held-out postures.", table5, 15.0, {"n": "postures"},
    ),
    Figure(
        "fig7", "Fig. 7", "The four cases of Table 5: the true posture, and transparent the predicted one.", fig7,
        6.0, {"n": "postures"}, ("fig7",), numbers=False,
    ),
    Figure(
        "fig8", "Fig. 8", "Mean absolute error [rad] of the joints of the Allegro hand.", fig8, 30.0,
        {"n": "postures"}, ("fig8",),
    ),
    Figure(
        "grasps", "Figs. 9 to 12", "One contact triple by two postures of a hand (Fig. 9) and by two hands (Fig. 10); "
        "grasps of the Barrett (Fig. 11) and the Allegro hand (Fig. 12), those of the paper's own chain first.",
        grasps, 120.0, {"starts": "drawn"}, ("fig9", "fig10", "fig11", "fig12"), numbers=False,
    ),
)  # fmt: skip
"""What is made one by one, in the order of the paper."""

TRIALS = (
    Trials(
        "table6", "Table 6", "How often grasps hold that the planner lets be ever less certain, on the paper's shape. "
        "The riskiest ones are lifted.", ROWS6, judge_table6, 22.0,
    ),
    Trials(
        "table7", "Table 7", "How often the same grasps hold under five ways of closing, each with the library's "
        "holding (force) and with its own. The paper compares its law with position control.", ROWS7, judge_table7,
        32.0,
    ),
    Trials(
        "ladder", "From the paper's chain to the default one", "One stage is exchanged at a time, and the best grasp "
        "lifted. An object without a grasp counts as lost. Worth is the paired difference to the row above.",
        RUNGS, judge_ladder, 50.0, repeated=False,
    ),
)  # fmt: skip
"""Tables of lifts."""
