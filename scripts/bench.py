#!/usr/bin/env python
"""Measure torchgrasp: python scripts/bench.py SUBJECT [--only BENCH ...] [--objects DIR] [options].

* headline: lifts, low, pulls, region, rendered, real, pace: what README says; --publish writes it

* gpu: clouds, launches: many clouds at once, also without a GPU

* plan: pace: time to grasps

* scene: real, rooms, target: supports and things in depth images, a given thing among others

Each bench prints rows, and writes them as JSON and as a Markdown table with commit, machine and
command. A run that was stopped goes on: rows of the same commit and options are kept in --out.
Times are for a quiet machine; beside other work set OMP_WAIT_POLICY=PASSIVE.
"""

import dataclasses
from collections.abc import Callable

import tyro
from benchmarks.common import Options, measure
from benchmarks.headline.page import write_headline

SUBJECTS = ("gpu", "headline", "plan", "scene")


def command(subject: str) -> Callable[[Options], None]:
    """Return the function that runs the benches of a subject, a subcommand of this script."""

    def run(options: tyro.conf.OmitArgPrefixes[Options]) -> None:
        if subject != "headline":
            measure(subject, options)
            return
        # one page for all of its benches
        rows = measure(subject, dataclasses.replace(options, publish=False))
        if options.publish:
            write_headline(rows, options)

    run.__doc__ = f"Run benches of {subject}; see scripts/bench.py --help."
    return run


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {name: command(name) for name in SUBJECTS}, description=__doc__
    )
