"""The report of one run as a page with pictures."""

import base64
import math
from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Int
from torch import Tensor

from torchgrasp.app.report.closing.film import describe_film, draw_film
from torchgrasp.app.report.document import escape, format_document, format_html_table
from torchgrasp.app.report.palette import FINGERS
from torchgrasp.app.report.pictures import (
    draw_cloud,
    draw_contacts,
    draw_grasp,
    draw_surface,
    facing,
    rotated,
    view_of,
)
from torchgrasp.app.report.run import Run, verdict
from torchgrasp.app.report.scenes import draw_among, draw_depth
from torchgrasp.base import count_status
from torchgrasp.checks import checked
from torchgrasp.files import write_file
from torchgrasp.planner.explain import Explanation
from torchgrasp.values import Grasps


@checked
def write_report(path: Path | str, run: Run, view: str = "") -> Path:
    """Write a run with its pictures as one HTML file, atomically.

    Args:
        path: file to write.
        run: what it shows.
        view: name of the page beside it that `write_viewer` wrote, if any; the report links to it.

    Raises:
        OutputError: the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import ContactSpec, fit_shape, load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> from torchgrasp.shape import extract_surface
    >>> view, none = load_object("jug").view, load_shipped_grasp("jug", "barrett")[:0]
    >>> surface, hand = extract_surface(fit_shape(view), 24), load_hand("barrett")
    >>> run = Run("jug", Path("jug.ply"), view, hand, ContactSpec(), surface, none, ())
    >>> "no executable grasp" in write_report(Path(tempfile.mkdtemp(), "report.html"), run).read_text()
    True
    """
    return write_file(path, format_page(run, draw_pictures(run), view))


@checked
def draw_pictures(run: Run) -> dict[str, list[tuple[str, bytes]]]:
    """Draw every picture of a run: captions and PNGs by section.

    >>> from torchgrasp import ContactSpec, fit_shape, load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> from torchgrasp.shape import extract_surface
    >>> view, none = load_object("jug").view, load_shipped_grasp("jug", "barrett")[:0]
    >>> surface, hand = extract_surface(fit_shape(view), 24), load_hand("barrett")
    >>> pictures = draw_pictures(Run("jug", Path("jug.ply"), view, hand, ContactSpec(), surface, none, ()))
    >>> {section: len(drawn) for section, drawn in pictures.items()}
    {'Seen and unseen': 3}
    """
    run = run.upright()
    table = None if run.spec.table is None else 0.0
    view, best = view_of(run.cloud), run.executable
    sections = {
        "Seen and unseen": [
            ("The cloud from the camera's side, coloured by height.", draw_cloud(run.cloud, table)),
            ("The estimated surface from the camera's side.", draw_surface(run.surface, view, table)),
            ("The same from behind, where nothing was seen.", draw_surface(run.surface, rotated(view, 180.0), table)),
        ]
    }
    if run.scene is not None:
        seen = [("The depth image: the target in full colour, the other things pale.", draw_depth(run.scene))]
        if len(best):
            among = draw_among(run.scene, run.surface, run.hand, best[0], view)
            seen.append(("The best grasp among the measured points of the other things.", among))
        sections = {"The scene": seen, **sections}
    if len(best):
        front = facing(best)
        sections["The best grasp"] = [
            ("Contacts with outward normals.", draw_contacts(run.surface, best.contacts[0], front, table)),
            ("The hand on the estimated surface.", draw_grasp(run.surface, run.hand, best[0], front, table)),
            ("The same from another side.", draw_grasp(run.surface, run.hand, best[0], rotated(front, 60.0), table)),
        ]
    if run.closure is not None and run.mesh is not None:
        side = rotated(facing(best), 20.0) if len(best) else view
        sections["Closing on the true object"] = [
            (describe_film(run.mesh, run.hand, run.closure), draw_film(run.mesh, run.hand, run.closure, side))
        ]
    return sections


def format_page(run: Run, pictures: dict[str, list[tuple[str, bytes]]], view: str = "") -> str:
    """Return the page of a run as text, with a link to its `view`."""
    good = run.closure.held if run.closure is not None else len(run.executable) > 0
    title = f"Grasps of the {run.object_name} with the {run.hand.name} hand"
    stages = [(s.name, s.message, f"{s.seconds:.1f}") for s in run.stages]
    stages.append(("total", "", f"{sum(s.seconds for s in run.stages):.1f}"))
    body = [
        f'<p class="source">from {escape(run.source)}, {len(run.cloud)} points</p>',
        f'<p class="verdict{"" if good else " bad"}">{escape(verdict(run))}</p>',
        *[f'<p class="view"><a href="{escape(view)}">Turn it, step through the grasps, replay the closing</a></p>']
        * bool(view),
        *(_section(name, shots, run) for name, shots in pictures.items()),
        "<h2>Stages</h2>",
        format_html_table(("stage", "result", "seconds"), stages, numbers={2}),
    ]
    if len(run.executable):
        rows = grasp_rows(run.executable)
        body.append(f"<h2>Best grasps ({len(rows)} of {len(run.executable)})</h2>")
        body.append(format_html_table(GRASP_COLUMNS, rows, numbers=range(len(GRASP_COLUMNS))))
        body.append(f'<p class="source">{GRASP_LEGEND}</p>')
    if run.explanation is not None:
        body += _explanation(run.explanation)
    if run.plan is not None:
        body += ["<h2>What became of every start</h2>", _statuses(run.plan.status)]
    if len(run.grasps):
        body += ["<h2>What became of every posture</h2>", _statuses(run.grasps.status)]
    facts = [(name.replace("_", " "), value) for name, value in sorted(run.grasps.meta.items())]
    body += ["<h2>Provenance</h2>", format_html_table(("what", "value"), facts, code={1})]
    return format_document(title, body)


def grasp_rows(grasps: Grasps, most: int = 10) -> list[tuple[str, ...]]:
    """Return the first grasps as text, in the order of `GRASP_COLUMNS`."""
    return [
        (
            str(rank),
            f"{float(grasp.success[0]):.0%}",
            f"{1e3 * float(grasp.tip_error[0].max()):.2f}",
            f"{1e3 * float(grasp.clearance[0]):.1f}",
            f"{math.degrees(float(grasp.normal_angle[0].max())):.0f}",
            f"{float(grasp.certificate.margin[0]):.4f}",
            "" if grasp.contacts.std_m is None else f"{1e3 * float(grasp.contacts.std_m[0].max()):.1f}",
        )
        for rank, grasp in enumerate(grasps[:most], 1)
    ]


GRASP_COLUMNS = ("rank", "success", "tip error mm", "clearance mm", "pad angle deg", "closure margin", "surface std mm")
"""Heads of `grasp_rows`; errors, angles and deviations are of the worst finger."""

GRASP_LEGEND = (
    "success: predicted probability that the grasp holds, from trials in simulation; tip error: how far a "
    "fingertip ends from its contact; clearance: least distance of links from the estimated object, the table and "
    "each other; pad angle: between the pad's axis and the contact's normal; closure margin: of the certificate, "
    "above 0 the contacts resist every wrench; surface std: standard deviation of the surface at a contact. Of "
    "several fingers the worst counts."
)
"""What the columns mean, below the table of a report."""


def _explanation(explanation: Explanation) -> list[str]:
    """Return where grasps were lost, and what each change gave."""
    lost = [(x.stage, f"{x.kept} of {x.given} {x.things}", x.reasons) for x in explanation.funnel.stages if x.given]
    tried = [(t.words, str(t.executable), f"{t.expected:.0%}") for t in explanation.trials]
    return [
        f"<h2>Where {explanation.starts} starts end</h2>",
        format_html_table(("stage", "kept", "lost"), lost),
        "<h2>What would help, by trial</h2>",
        format_html_table(("change", "executable grasps", "expected success of the best"), tried, numbers={1, 2}),
    ]


def _statuses(status: Int[Tensor, "b"]) -> str:
    """Return the table of statuses with their counts."""
    rows = [(str(n), s.name.lower(), s.sentence) for s, n in count_status(status).items()]
    return format_html_table(("count", "status", "meaning"), rows, numbers={0})


def _section(name: str, shots: Sequence[tuple[str, bytes]], run: Run) -> str:
    """Return a section of pictures, with a legend of the fingers."""
    legend = "".join(
        f'<span class="dot" style="background:{color}"></span>{escape(finger)}'
        for finger, color in zip(run.hand.tips.names, FINGERS, strict=False)
    )
    figures = "\n".join(
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{base64.b64encode(png).decode("ascii")}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        for caption, png in shots
    )
    fingers = f"<p>{legend}</p>" if name == "The best grasp" else ""
    pairs = " pairs" if len(shots) % 3 else ""
    return f'<h2>{escape(name)}</h2>\n{fingers}<div class="grid{pairs}">\n{figures}\n</div>'
