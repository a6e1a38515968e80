#!/usr/bin/env python
"""Reproduce figures and tables of the paper with the objects of torchgrasp.

    python scripts/reproduce.py COMMAND --out DIR

* all: every table and figure that needs no lift, one after the other
* table3: how many points the filter keeps, and how long a shape takes
* fig4: whole and partial clouds, and the shapes that follow from them
* table4: how many of 1000 starts end in a grasp, how fast and how near the centre
* fig5: planned contacts on the objects
* table5: errors of the Barrett hand's learned model; fig7: four of them drawn
* fig6: the number of Gaussians by BIC and by cross-validation
* fig8: errors of the Allegro hand's learned model
* grasps: Figs. 9 to 12: one contact triple by two postures and by two hands; grasps
* table6: how often ever riskier grasps hold; table7: under five closings
"""

from pathlib import Path

import tyro
from paper.fig4 import fig4
from paper.fig6 import fig6
from paper.fig9_to_12 import grasps
from paper.table3 import table3
from paper.table4_fig5 import fig5, table4
from paper.table5_fig7_fig8 import fig7, fig8, table5
from paper.tables6_7 import table6, table7

DRAWN = (table3, fig4, table4, fig5, table5, fig6, fig7, fig8, grasps)
"""Tables and figures in the order of the paper, without those of lifts."""


def reproduce_all(out: Path) -> None:
    """Make every table and figure that needs no lift.

    Args:
        out: folder of the tables and pictures.
    """
    for make in DRAWN:
        print(f"\n{make.__name__}", flush=True)
        make(out)


if __name__ == "__main__":
    commands = {"all": reproduce_all}
    commands |= {make.__name__: make for make in (*DRAWN, table6, table7)}
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="reproduce.py", description="Figures and tables of the paper."
    )
