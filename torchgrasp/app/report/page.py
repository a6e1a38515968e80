"""The HTML report of one run with pictures, and the rendering of all pages."""

import base64
from pathlib import Path
from typing import Any

from torchgrasp import __version__, files
from torchgrasp.app.report import stills
from torchgrasp.app.report.canvas import FINGERS
from torchgrasp.app.report.film import describe_film, draw_film
from torchgrasp.app.report.run_data import Run, grasp_columns, grasp_rows, verdict
from torchgrasp.app.report.scene_picture import encode_scene
from torchgrasp.foundation.base import count_status
from torchgrasp.foundation.checks import checked

TEMPLATES = Path(__file__).with_name("templates")  # of all pages
ASIDE = 60.0  # between the two views of a grasp [degrees]
FILM_TURN = 20.0  # of the film's view, so that fingers in line do not hide each other [degrees]
Sections = dict[str, list[tuple[str, bytes]]]  # captions and PNGs by the title of a section


@checked
def write_report(path: Path | str, run: Run, view: str = "") -> Path:
    """Write the report of a run, with its pictures, as one HTML file, atomically; return the path.

    Args:
        path: the file to write.
        run: the inputs and results that the report shows.
        view: name of the file that `write_viewer` wrote into the same folder; the report links to
            it. "" means no link.

    Raises `OutputError` if the file cannot be written, and `BadArgument` if the executable grasps
    do not touch the run's mesh. These are the grasps that passed all checks.

    >>> import tempfile
    >>> from torchgrasp import ContactSpec, fit_shape, load_hand, load_object
    >>> from torchgrasp.shape import extract_surface
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> jug, hand = load_object("jug"), load_hand("barrett")
    >>> surface = extract_surface(fit_shape(jug.view), 24)
    >>> grasps = load_shipped_grasp("jug", "barrett")
    >>> run = Run("jug", Path("jug.ply"), jug.view, hand, ContactSpec(), surface, grasps)
    >>> "executable grasp" in write_report(Path(tempfile.mkdtemp(), "report.html"), run).read_text()
    True
    """
    return files.write_file(path, format_page(run, draw_pictures(run), view))


def draw_pictures(run: Run) -> Sections:
    """Return all pictures of a run: pairs of caption and PNG bytes, by the title of their section.

    Raises `BadArgument` if the executable grasps, which passed all checks, do not touch the run's
    mesh. It is also raised for a table above most points of the cloud.
    """
    run = run.upright()
    table = run.spec.plane
    view = stills.view_of(run.cloud)
    best = run.executable
    behind = stills.rotated(view, 180.0)
    sections: Sections = {}
    if run.scene is not None:
        found = encode_scene(run.scene)
        seen = [("What was found in the depth image; the target has a white rim.", found)]
        if len(best):
            among = stills.draw_among(run.scene, run.surface, run.hand, best[0], view)
            seen.append(("The best grasp among the measured points of the other objects.", among))
        sections["The scene"] = seen
    cloud = stills.draw_cloud(run.cloud, table)
    front, back = (stills.draw_surface(run.surface, side, table) for side in (view, behind))
    sections["Seen and unseen"] = [
        ("The cloud from the camera's side, coloured by height.", cloud),
        ("The estimated surface from the camera's side.", front),
        ("The same from behind, where nothing was seen.", back),
    ]
    film_side = view
    if len(best):
        side = stills.facing(best)
        film_side = stills.rotated(side, FILM_TURN)
        contacts = stills.draw_contacts(run.surface, best.contacts[0], side, table)
        front, aside = (
            stills.draw_grasp(run.surface, run.hand, best[0], direction, table)
            for direction in (side, stills.rotated(side, ASIDE))
        )
        sections["The best grasp"] = [
            ("Contacts with outward normals.", contacts),
            ("The hand on the estimated surface.", front),
            ("The same from another side.", aside),
        ]
    if run.closure is not None and run.mesh is not None:
        film = draw_film(run.mesh, run.hand, run.closure, film_side, table and table.edge)
        caption = describe_film(run.mesh, run.hand, run.closure)
        sections["Closing on the true object"] = [(caption, film)]
    return sections


def format_page(run: Run, pictures: Sections, view: str = "") -> str:
    """Return the HTML report of a run as text.

    `pictures` holds pairs of caption and PNG bytes by the title of their section (`draw_pictures`).
    `view` is the address of the 3D page to which the report links, or "" for no link.
    """
    funnel = run.explanation.funnel.stages if run.explanation else ()
    trials = run.explanation.trials if run.explanation else ()
    outcomes = []
    if run.plan is not None:
        outcomes.append(("Outcome of every initial guess", run.plan.status))
    if len(run.grasps):
        outcomes.append(("Outcome of every posture", run.grasps.status))
    origin = (("command", run.command), ("date", run.date), ("torchgrasp", __version__))
    return render(
        "report.html",
        title=run.title,
        run=run,
        version=__version__,
        verdict=verdict(run),
        good=run.good,
        view=view,
        sections=[
            (name, [(caption, encode_base64(png)) for caption, png in shots])
            for name, shots in pictures.items()
        ],
        fingers=list(zip(run.hand.tips.names, FINGERS, strict=False)),
        stages=[
            *((name, result, f"{seconds:.1f}") for name, result, seconds in run.stages),
            ("total", "", f"{sum(seconds for *_, seconds in run.stages):.1f}"),
        ],
        columns=grasp_columns(run.grasps),
        rows=grasp_rows(run.executable),
        lost=[(x.stage, f"{x.kept} of {x.given} {x.things}", x.reasons) for x in funnel if x.given],
        tried=[(t.words, str(t.executable), f"{t.expected:.0%}") for t in trials],
        outcomes=[
            (name, [(str(n), s.name.lower(), s.sentence) for s, n in count_status(status).items()])
            for name, status in outcomes
        ],
        facts=[
            *(pair for pair in origin if pair[1]),
            *((name.replace("_", " "), value) for name, value in sorted(run.grasps.meta.items())),
        ],
    )


def encode_base64(data: bytes) -> str:
    """Return bytes as base64 text, as pages embed them."""
    return base64.b64encode(data).decode("ascii")


def render(template: str, **values: Any) -> str:
    """Return a page made from the template file `template` of this package and values by name.

    Values of type `markupsafe.Markup` are inserted as HTML; others are escaped.
    """
    return files.render(TEMPLATES / template, **values)
