"""The commands `torchgrasp evaluate` and `campaign`: grasps tried in simulation, for statistics or
a data set.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from torchgrasp import evaluation
from torchgrasp.app.cli.command import (
    Command,
    ForPrograms,
    answer,
    arguments,
    make_bar,
    naming,
    option,
    positional,
    required,
)
from torchgrasp.app.cli.inputs import (
    FINGERS_HELP,
    HAND_HELP,
    SEED_HELP,
    STARTS_HELP,
    import_simulator,
    load_fingers,
    read_distribution,
)
from torchgrasp.app.report.evaluation_page import (
    SHARE_NAMES,
    list_causes,
    list_figures,
    write_evaluation,
)
from torchgrasp.campaign import CampaignSpec, run_campaign
from torchgrasp.campaign.folder import FAILED
from torchgrasp.data import JobRow, read_entries, write_parquet
from torchgrasp.data.table_folder import SOURCE, import_arrow
from torchgrasp.evaluation.intervals import format_share
from torchgrasp.evaluation.protocols import find_protocol
from torchgrasp.evaluation.summary import ViewScore, summarise
from torchgrasp.evaluation.sweep import evaluate
from torchgrasp.evaluation.views import EvaluationSpec, Ranks
from torchgrasp.files import (
    check_begun,
    format_columns,
    format_json,
    format_line,
    hold_folder,
    write_file,
)
from torchgrasp.foundation.errors import BadArgument, DatasetError, Status
from torchgrasp.foundation.rules import Count, Range, Seed
from torchgrasp.hand.hand import Hand
from torchgrasp.values.specs import ClosingMode, HoldingMode, Simulator

NAME_WIDTHS = (12, 6)  # of the names of object and view, where their longest is not known yet
COUNT_WIDTHS = (5, 7, -1)  # of executable grasps, of passed ones, and of reasons
COUNT_HEADS = ("exec.", "passed", "why others did not pass")  # titles of these columns
# title of the last column where fingertips were measured, too
TOUCH_HEAD = "fingertips before any force, and why others did not pass"
OBJECTS_HELP = (
    "folder with manifest.json, and for each object mesh.ply and noisy views; see docs/data.md"
)
PROTOCOL_HELP = (
    "the test that decides on success. multidex, dexgraspbench and pose-noise pull at a floating "
    "object; the others lift it from a table. See torchgrasp.evaluation.protocols"
)
Protocol = Literal[
    "multidex",
    "dexgraspbench",
    "dexgraspbench-hard",
    "pose-noise",
    "paper",
    "tabletop",
    "household",
    "table-lift",
]


@arguments(folder="out", path="out")
class _Trials(Command):
    """Arguments that `evaluate` and `campaign` share: hand, protocol options, grasps and views."""

    hand: str = required(HAND_HELP)
    out: Path = required("folder of the results; no other run may use it at the same time")
    fingers: str = option("default", FINGERS_HELP)
    closing: ClosingMode | None = option(
        None, "how the hand closes; by default as the protocol says"
    )
    simulator: Simulator = option("sapien", "physics simulator")
    grasps: int = option(20, "most grasps that are tried of each view")
    ranks: Ranks = option(
        "best", "the grasps that are tried: the best, or grasps spread over all ranks"
    )
    starts: Count = option(1000, STARTS_HELP)
    only: tuple[str, ...] = option((), "names of objects to use; by default all")
    views: int | None = option(None, "most views of each object; by default all")
    seed: Seed = option(0, SEED_HELP)

    def trial(self, **changes: Any) -> dict[str, Any]:
        """Return by name the options of the simulated trial that the user set.

        `changes` are further options; those that are None are left out.
        """
        changes |= {"closing": self.closing, "simulator": self.simulator}
        return {name: value for name, value in changes.items() if value is not None}


@arguments()
class Evaluate(_Trials, ForPrograms):
    """Plan on each noisy view of a folder's objects, and test the best grasps in simulation.

    Prints a line for each view, then success rates with 95 % intervals over families of objects.
    Writes evaluate.json, evaluate.html, and a folder of grasps.
    """

    objects: Path = required(OBJECTS_HELP)
    fingers: str = option(
        "default", f'{FINGERS_HELP}; "auto" takes for each view the most likely option to succeed'
    )
    protocol: Protocol = option("dexgraspbench", PROTOCOL_HELP)
    holding: HoldingMode | None = option(
        None,
        'how the hand presses after closing; by default as the protocol says, or "force" with '
        "--force",
    )
    force: float | None = option(
        None, "normal force of the strongest finger [N]; by default as the protocol says"
    )
    friction: str | None = option(
        None,
        "coefficient of friction, or its distribution, such as 0.3:0.8, from which each trial "
        "draws; by default as the protocol says",
    )
    mass: str | None = option(
        None, "mass of the objects [kg], or its distribution; by default as the protocol says"
    )
    displaced: float | None = option(
        None,
        "lifts: most that the object is displaced on each axis of the table [m]; by default as "
        "the protocol says",
    )
    during: bool = option(False, "displace the object halfway through the approach, not before it")
    relook: bool = option(
        False, "lifts: a camera looks at the displaced object once more, before the approach"
    )
    push: float | None = option(
        None, "lifts: size of a force in a random direction on the lifted object [N]"
    )
    draws: Count | None = option(
        None,
        "trials of each grasp, with other displacements, pushes and noise; by default as the "
        "protocol says",
    )
    complete: bool = option(False, "plan on the whole cloud instead of each view")
    planned: Path | None = option(
        None, 'folder "grasps" of an earlier run, whose grasps are tested'
    )
    workers: int = option(1, "processes; the results do not depend on their number")

    def disturbed(self, test: evaluation.Protocol) -> evaluation.Protocol:
        """Return the protocol `test` with the displacement, push, second look and number of trials
        that the user set by options.

        Raises `BadArgument` for --displaced with a protocol that does not lift, and for --during
        without a displacement.
        """
        noise = (
            test.noise if self.draws is None else dataclasses.replace(test.noise, draws=self.draws)
        )
        if self.displaced is not None:
            if test.pull is not None:
                raise BadArgument(
                    "--displaced", self.displaced, f"a protocol that lifts, not {test.name}"
                )
            with naming(translation="--displaced"):
                noise = dataclasses.replace(noise, translation=self.displaced, rotation=0.0)
        if self.during and not noise.translation:
            raise BadArgument("--during", "no displacement", "--displaced beside it")
        push = test.push if self.push is None else self.push
        relook = self.relook or test.relook
        when = "approach" if self.during else test.displaced
        return dataclasses.replace(test, noise=noise, push=push, relook=relook, displaced=when)

    def run(self) -> int:
        """Evaluate the objects, write the results and print the summary; return the exit code 0."""
        import_simulator(self.simulator)
        hand, among = load_fingers(self.hand, self.fingers)
        test = self._test()
        spec = EvaluationSpec(
            grasps=self.grasps,
            ranks=self.ranks,
            starts=self.starts,
            complete=self.complete,
            only=self.only,
            planned=self.planned is not None,
            seed=self.seed,
            views=self.views,
            fingers=among,
        )
        with hold_folder(self.out):
            scores = self._score(hand, test, spec)
            summary = summarise(scores)
            print_summary(self.protocol, spec.tried, summary)
            asked: dict[str, Any] = {
                "hand": self.hand,
                "tried": spec.tried,
                "hand_sha256": hand.source.sha256,
            }
            asked |= dataclasses.asdict(spec) | {"fingers": among or hand.source.option}
            asked["protocol"] = dataclasses.asdict(test)
            content = {
                "asked": asked,
                "summary": summary,
                "views": [dataclasses.asdict(score) for score in scores],
            }
            write_file(self.out / "evaluate.json", format_json(content))
            answer(content)
            title = f"Grasps of the {self.hand} hand under {self.protocol}"
            write_evaluation(self.out / "evaluate.html", title, asked, scores)
        return 0

    def _test(self) -> evaluation.Protocol:
        """Return the protocol with all options that the user set."""
        test = self.disturbed(find_protocol(self.protocol))
        truth = {
            name: read_distribution(f"--{name}", text)
            for name in ("friction", "mass")
            if (text := getattr(self, name)) is not None
        }
        holding = self.holding or (self.force and "force")
        return test.with_trial(**self.trial(force=self.force, holding=holding, **truth))

    def _score(
        self, hand: Hand, test: evaluation.Protocol, spec: EvaluationSpec
    ) -> list[ViewScore]:
        """Evaluate all views, and print a line for each; return their scores."""
        folder = self.planned or self.out / "grasps"
        found = evaluate(self.objects, hand, test, spec, folder=folder, workers=self.workers)
        names = list_names(self.objects, spec)
        widths = max(len(ascii(name)) for name, _ in names), max(len(view) for _, view in names)
        _print_cells(("object", "view", *COUNT_HEADS[:-1], TOUCH_HEAD), widths)
        scores = []
        with make_bar(sum(view != "" for _, view in names), "view") as bar:
            for score in found:
                with bar.external_write_mode(sys.stdout):
                    print_score(score, widths)
                bar.update()
                scores.append(score)
        return scores


def list_names(objects: Path, spec: EvaluationSpec) -> list[tuple[str, str]]:
    """Return object name and view name of every view of the folder `objects` that is evaluated.

    `spec` says which objects, and how many views of each. An object without views, or one whose
    entry is malformed, has one pair with the view name "".
    """
    names = []
    for name, entry in read_entries(objects, spec.only).items():
        bad = isinstance(entry, DatasetError)  # a bad entry is refused when it is evaluated
        views = [] if bad else entry.list_views(spec.complete, spec.views)
        names += [(name, view) for view in views or [""]]
    return names


def print_score(score: ViewScore, widths: tuple[int, int]) -> None:
    """Print one line with the result of a view: names of object and view, and how its grasps did.

    `widths` are the widths [characters] of the columns with the names of object and view.
    """
    failed = [attempt.status for attempt in score.attempts if not attempt.passed]
    reasons = ", ".join(
        f"{failed.count(status)} {status.name.lower()}" for status in dict.fromkeys(failed)
    )
    reasons = reasons if score.attempts else score.note or score.refusal.sentence
    verdicts = [attempt.touch for attempt in score.attempts if attempt.touch]
    if verdicts:
        most = max(attempt.gap_mm for attempt in score.attempts if attempt.touch)
        touching = f"{verdicts.count('touches')}/{len(verdicts)} touch, gap {most:.1f} mm"
        reasons = "; ".join(filter(None, (touching, reasons)))
    passed = f"{sum(attempt.passed for attempt in score.attempts)}/{len(score.attempts)}"
    cells = (score.object, score.view, score.executable, passed, reasons)
    _print_cells(cells, widths)


def _print_cells(cells: tuple[object, ...], widths: tuple[int, int]) -> None:
    """Print a line of object, view, counts and reasons."""
    print(format_line(cells, (-widths[0], -widths[1], *COUNT_WIDTHS)), flush=True)


def print_summary(protocol: str, tried: str, summary: dict[str, Any]) -> None:
    """Print the success rates of all objects and of each group of them, failures by stage and
    cause, and times.

    `protocol` and `tried`, texts on how and what was tested, are printed as the title. `summary`
    holds the statistics of an evaluation, by name (`torchgrasp.evaluation`).
    """
    rows = [(text, format_share(summary[key])) for key, text in SHARE_NAMES.items()]
    for name, group in summary["by_group"].items():
        rows += [(f"{name}: {text}", format_share(group[key])) for key, text in SHARE_NAMES.items()]
    if len(summary["fingers"]) > 1:
        sets = [f"{n} {names}" for names, n in summary["fingers"].items()]
        rows.append(("views by fingers", "; ".join(sets)))
    for stage, reasons in summary["failures"].items():
        lost = [f"{n} {name.lower()}" for name, n in reasons.items()]
        rows.append((f"failed in {stage}", ", ".join(lost)))
    rows += [(f"not held: {name}", text) for name, text in list_causes(summary)]
    print(f"\n{protocol}, {tried}\n{format_columns([*rows, *list_figures(summary)], left={0, 1})}")


@arguments()
class RunCampaign(_Trials):
    """Write a data set: for each view its cloud, grasps, proofs of closure, predicted and simulated
    success.

    Prints a line for each job, one object and view. Writes shards of safetensors with README.md and
    card.json, which torchgrasp.data.read_shards reads. The same command continues a run that was
    interrupted or killed. It also tries failed jobs again: worker_died, timed_out, and broken, an
    error of the library. The exit code is 1 while failed jobs are left.
    """

    objects: Path = positional(OBJECTS_HELP)
    protocol: Protocol = option("tabletop", PROTOCOL_HELP)
    licence: str = option("unknown", "licence of the data set, for its card, as CC-BY-4.0")
    parquet: Path | None = option(
        None, "folder for the same data as Parquet, for `datasets.load_dataset`"
    )
    jobs_in_shard: int = option(64, "number of jobs whose records share a file")
    workers: Annotated[int, Range(0, 1024)] = option(
        1, "processes here, 0: this one; the data do not depend on their number"
    )
    device: Literal["cpu", "cuda"] = option(
        "cpu",
        'with "cuda" the workers of --scheduler that have the resource "GPU" plan on all views of '
        "a file at once",
    )
    scheduler: str | None = option(
        None, "Dask scheduler, as tcp://10.0.0.1:8786, whose workers do the jobs instead"
    )

    def run(self) -> int:
        """Run the campaign and print its counts; return the exit code."""
        import_simulator(self.simulator)
        if self.parquet is not None:
            import_arrow()  # not after hours
            with naming(folder="--parquet"):
                check_begun(self.parquet / SOURCE)
        if self.fingers == "auto":
            raise BadArgument("--fingers", "auto", "one set of fingers for all records")
        hand, _ = load_fingers(self.hand, self.fingers)
        trials = EvaluationSpec(
            self.grasps, self.ranks, self.starts, only=self.only, seed=self.seed, views=self.views
        )
        test = find_protocol(self.protocol).with_trial(**self.trial())
        spec = CampaignSpec(test, trials, self.licence, self.jobs_in_shard, self.device)
        source = self.workers if self.scheduler is None else self.scheduler
        name = "--workers" if self.scheduler is None else "--scheduler"
        with naming(workers=name), make_bar(len(list_names(self.objects, trials)), "job") as bar:
            _print_cells(("object", "view", *COUNT_HEADS), NAME_WIDTHS)

            def show(row: JobRow) -> None:
                reason = "" if row.status is Status.OK else row.note or row.status.sentence
                cells = row.object, row.view, row.executable, f"{row.passed}/{row.grasps}", reason
                with bar.external_write_mode(sys.stdout):
                    _print_cells(cells, NAME_WIDTHS)
                bar.update()

            data = run_campaign(self.objects, hand, self.out, spec, source, show)
        counts = data.card["counts"]
        ended = ", ".join(f"{n} {name.lower()}" for name, n in counts["status"].items())
        print(f"{counts['jobs']} jobs: {ended}")
        passed = f"{counts['passed']} of {counts['tries']} tries passed"
        print(f"{len(data)} grasps, {passed}: {self.out}")
        if self.parquet is not None:
            with naming(folder="--parquet", path="--parquet", data="OBJECTS"):
                write_parquet(data, self.parquet)
        failed = [row for row in data.jobs if row.status in FAILED]
        if failed:
            reasons = ", ".join(sorted({row.status.name.lower() for row in failed}))
            jobs = "1 job" if len(failed) == 1 else f"{len(failed)} jobs"
            print(
                f"{jobs} failed by no fault of the object ({reasons}): the same command tries again"
            )
        return 1 if failed else 0
