#!/usr/bin/env python
"""Reproduce figures and tables of the paper with the objects of torchgrasp.

python scripts/reproduce.py all --out DIR     all of what follows, on one page beside the paper's
numbers; resumable python scripts/reproduce.py fig4 --out DIR    whole and partial clouds, and the
shapes that follow from them python scripts/reproduce.py table3 --out DIR  how many points the
filter keeps, and how long a shape takes python scripts/reproduce.py table4 --out DIR  how many of
1000 starts end in a grasp, how fast and how near the centre python scripts/reproduce.py fig5 --out
DIR    planned contacts on the objects python scripts/reproduce.py table5 --out DIR  errors of the
Barrett hand's learned model; fig7: four of them drawn python scripts/reproduce.py fig6 --out DIR
the number of Gaussians by BIC and by cross-validation python scripts/reproduce.py fig8 --out DIR
errors of the Allegro hand's learned model python scripts/reproduce.py grasps --out DIR  Figs. 9-12:
one contact triple by two postures and by two hands; grasps python scripts/reproduce.py funnel
what each stage of the paper's chain leaves over, from starts to lifts python scripts/reproduce.py
table6 --out DIR  how often ever riskier grasps hold; table7: under five closings python
scripts/reproduce.py deviations --out DIR  how often the paper's equations fail as written:
docs/paper.md python scripts/reproduce.py ladder --out DIR  from the paper's chain to the library's,
one stage exchanged at a time python scripts/reproduce.py claims            the figures of README
and guides again: said, found, held
"""

import tyro
from claims.run import claims
from paper.deviations import deviations
from paper.fig4 import fig4
from paper.fig6 import fig6
from paper.fig9_to_12 import grasps
from paper.funnel import funnel
from paper.ladder import ladder
from paper.table3 import table3
from paper.table4_fig5 import fig5, table4
from paper.table5_fig7_fig8 import fig7, fig8, table5
from paper.tables6_7 import table6, table7
from paper.whole import reproduce_all

if __name__ == "__main__":
    commands = {
        "all": reproduce_all,
        "table3": table3,
        "fig4": fig4,
        "table4": table4,
        "fig5": fig5,
    }
    commands |= {"table5": table5, "fig6": fig6, "fig7": fig7, "fig8": fig8, "grasps": grasps}
    commands |= {
        "table6": table6,
        "table7": table7,
        "ladder": ladder,
        "deviations": deviations,
        "claims": claims,
    }
    commands |= {"funnel": funnel}
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="reproduce.py", description="Figures and tables of the paper."
    )
