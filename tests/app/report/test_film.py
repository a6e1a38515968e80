"""A ball in three fingertips that rise: where the film says that it was lost is where it was made
to be lost.
"""

import dataclasses
import io
import math

import numpy as np
import pytest
import torch
from PIL import Image

from torchgrasp.app.report.canvas import ALARM, PAPER, SHADOW, Canvas, rgb
from torchgrasp.app.report.closing_moments import explain_loss, find_loss, moments_of, moved_in_hand
from torchgrasp.app.report.film import FILM, _list_plots, describe_film, draw_film
from torchgrasp.app.report.raster import Camera
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.closing import ClosingTrace

F64 = torch.float64
TICKS = 100
NAMES = ("index", "middle", "thumb")
CENTRE = torch.zeros(3, dtype=F64)


@pytest.fixture
def closing(run):
    """Touches at 0.2, 0.3 and 0.4 s, pressed at 0.5 s, then a rise of 0.2 m/s with the object, held
    to the end.
    """
    rise = 0.2 * (torch.arange(TICKS, dtype=F64) / 100 - 0.5).clamp(min=0.0)
    lifted = torch.eye(4, dtype=F64).repeat(TICKS, 1, 1)
    lifted[:, 2, 3] = rise
    touched = torch.arange(TICKS)[:, None] >= torch.tensor([20, 40, 30])
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(TICKS, 3, 3)
    normals = torch.where(touched[..., None], normal, math.nan)
    trace = ClosingTrace(
        forces=torch.tensor([0.3, 0.0, -1.0], dtype=F64).expand(TICKS, 3, 3).clone(),
        points=normals,
        normals=normals,
        sliding=torch.zeros(TICKS, 3, dtype=F64),
        blend=torch.full((TICKS, 3), 0.5, dtype=F64),
        friction=torch.full((TICKS,), math.nan, dtype=F64),
        load=torch.full((TICKS,), math.nan, dtype=F64),
    )
    return dataclasses.replace(
        run.closure,
        time=torch.arange(TICKS, dtype=F64) / 100,
        forces=touched.double(),
        object_pose=lifted,
        hand_pose=run.closure.hand_pose[:1].double() @ lifted,
        joints=run.closure.joints[:1].expand(TICKS, -1).clone(),
        targets=run.closure.targets[:1].expand(TICKS, -1).clone(),
        contact_order=(0, 2, 1),
        trace=trace,
        phases=torch.tensor([0.1, 0.4, 0.5], dtype=F64),
    )


def lost(closing, status, **changes):
    return dataclasses.replace(closing, held=False, status=status, **changes)


def slipping(closing, begin):
    """Leave the object behind from a tick on; the third finger slides, and lets go 20 ticks later."""
    pose = closing.object_pose.clone()
    trace = closing.trace
    pose[begin:, 2, 3] = pose[begin, 2, 3]
    sliding = trace.sliding.clone()
    normals = trace.normals.clone()
    sliding[begin:, 2] = 0.2
    normals[begin + 20 :] = math.nan
    trace = dataclasses.replace(trace, sliding=sliding, normals=normals)
    return lost(closing, Status.NOT_LIFTED, object_pose=pose, trace=trace)


def test_a_held_closing_has_its_touches_and_phases_as_moments_and_no_loss(closing):
    assert find_loss(closing, CENTRE) is None and explain_loss(closing, CENTRE, NAMES) == ""
    names = ["open hand", "index touches first", "all touch", "pressed", "the end"]
    moments = moments_of(closing, CENTRE, NAMES)
    assert [moment.name for moment in moments] == names
    assert [moment.tick for moment in moments] == [10, 20, 40, 50, 99]
    assert all(float(part.max()) < 1e-7 for part in moved_in_hand(closing, CENTRE))


def test_what_slides_out_is_lost_where_it_has_slipped_too_far(closing):
    """At 0.2 m/s, 20 mm of slip take 10 ticks: the eleventh is beyond."""
    out = slipping(closing, 60)
    assert abs(find_loss(out, CENTRE) - 70) <= 1
    why = explain_loss(out, CENTRE, NAMES)
    assert (
        "while the hand rose: thumb slid first, from 0.60 s on, under 0.3 N across at 1.0 N of normal force"
        in why
    )
    assert [m.name for m in moments_of(out, CENTRE, NAMES)][-2:] == ["lost", "the end"]


def test_what_nobody_touches_is_lost_at_the_last_touch(closing):
    normals = closing.trace.normals.clone()
    normals[63:, 1] = math.nan
    normals[66:, 0] = math.nan
    out = lost(closing, Status.DROPPED, trace=dataclasses.replace(closing.trace, normals=normals))
    assert find_loss(out, CENTRE) == 66
    assert "middle let go first, at 0.63 s" in explain_loss(out, CENTRE, NAMES)


def test_a_finger_that_never_came_is_named(closing):
    normals = closing.trace.normals.clone()
    normals[:, 1:] = math.nan
    trace = dataclasses.replace(closing.trace, normals=normals)
    out = lost(closing, Status.NO_CONTACT, trace=trace, contact_order=(0,))
    assert "middle and thumb never touched the object" in explain_loss(out, CENTRE, NAMES)


def test_what_is_pushed_away_is_lost_where_it_has_gone_too_far(closing):
    pose = torch.eye(4, dtype=F64).repeat(TICKS, 1, 1)
    pose[:, 0, 3] = 0.01 * (torch.arange(TICKS, dtype=F64) - 40.5).clamp(min=0.0)
    out = lost(closing, Status.EJECTED, object_pose=pose)
    assert find_loss(out, CENTRE) == 46  # 55 mm, the first beyond 50 mm
    assert "while the hand closed" in explain_loss(out, CENTRE, NAMES)


def test_what_is_too_heavy_is_put_down_from_the_top(closing):
    pose = closing.hand_pose.clone()
    pose[80:, 2, 3] = pose[:20, 2, 3]
    out = lost(closing, Status.TOO_HEAVY, hand_pose=pose)
    assert find_loss(out, CENTRE) == 79
    assert explain_loss(out, CENTRE, NAMES).startswith("Put down from 0.79 s")
    assert Status.TOO_HEAVY.sentence in explain_loss(out, CENTRE, NAMES)


def picture(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def near(pixels, color):
    return np.abs(pixels - np.round(255 * np.array(rgb(color)))).max(-1) < 20


def test_the_film_shows_the_loss_in_its_colour_and_the_object_falling_behind(run, closing):
    held = picture(draw_film(run.mesh, run.hand, closing, (1.0, 0.0, 0.3)))
    out = slipping(closing, 60)
    gone = picture(draw_film(run.mesh, run.hand, out, (1.0, 0.0, 0.3)))
    assert held.shape == gone.shape and held.shape[1] == FILM.width
    assert not near(held[: FILM.title], ALARM).any() and near(gone[: FILM.title], ALARM).any()
    assert near(gone[FILM.still :], ALARM).sum() > near(held[FILM.still :], ALARM).sum() + 300

    def height(film, count, k):
        """The lowest row of the sand-coloured object in a still; the hand may hide its upper part."""
        tile = film[
            FILM.title : FILM.still, k * FILM.width // count : (k + 1) * FILM.width // count
        ]
        sand = (tile[..., 0] > tile[..., 2] + 25) & (tile[..., 0] < tile[..., 1] + 45)
        return np.nonzero(sand)[0].max()

    # The camera stands in the world: what is held rises in the picture, and what was lost stays
    # where it is.
    assert height(held, 5, 4) < height(held, 5, 3) - 10
    assert abs(height(gone, 6, 5) - height(gone, 6, 4)) < 2
    assert "index, thumb, middle. The object was held." in describe_film(
        run.mesh, run.hand, closing
    )
    assert "Lost at 0.7" in describe_film(run.mesh, run.hand, out)
    again = describe_film(run.mesh, run.hand, dataclasses.replace(closing, stops=1, attempts=2))
    assert "held. On its way the hand touched something once. The hand closed 2 times." in again


def test_the_last_of_several_closings_is_a_moment_where_the_law_acts_again(closing):
    blend = torch.full((TICKS, 3), math.nan, dtype=F64)
    blend[11:30, 0] = 0.5
    blend[42:48] = 0.5
    trace = dataclasses.replace(closing.trace, blend=blend)
    again = moments_of(dataclasses.replace(closing, trace=trace, attempts=2), CENTRE, NAMES)
    assert [m.tick for m in again if m.name == "closing 2 begins"] == [42]
    unknown = moments_of(dataclasses.replace(closing, trace=trace, attempts=3), CENTRE, NAMES)
    assert not any("begins" in m.name for m in unknown)


def test_a_shadow_lies_below_what_throws_it():
    """Straight below a square at a height, the table is dark within its outline alone."""
    square = np.array(
        [[-0.02, -0.02, 0.1], [0.02, -0.02, 0.1], [0.02, 0.02, 0.1], [-0.02, 0.02, 0.1]]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    around = np.array([[-0.1, -0.1, 0.0], [0.1, 0.1, 0.1]])
    canvas = Canvas()
    canvas.add_table(around, 0.0, [(square, faces)])
    camera = Camera(
        np.array([0.0, 0.0, 1.0]), np.eye(3), math.atan(0.1) * 2
    )  # from above, 0.1 m to each side
    dark = near(canvas.render(camera, (200, 200)).astype(int), SHADOW)
    rows, columns = np.nonzero(dark)
    assert [rows.min(), rows.max(), columns.min(), columns.max()] == pytest.approx(
        [80, 119, 80, 119], abs=1
    )
    assert dark.sum() == pytest.approx(40 * 40, rel=0.06)


def test_a_table_is_drawn_as_far_as_its_edge():
    """From above, to the right of x = 0.02 m there is paper alone, without a shadow."""
    edge = Plane.horizontal(0.0).ending(real([0.02, 0.0, 0.0]), real([1.0, 0.0, 0.0]))
    square = np.array([[0.0, -0.02, 0.1], [0.05, -0.02, 0.1], [0.05, 0.02, 0.1], [0.0, 0.02, 0.1]])
    around = np.array([[-0.1, -0.1, 0.0], [0.1, 0.1, 0.1]])
    pictures = []
    for table in (Plane.horizontal(0.0), edge):
        canvas = Canvas()
        canvas.add_table(around, table, [(square, np.array([[0, 1, 2], [0, 2, 3]]))])
        camera = Camera(np.array([0.0, 0.0, 1.0]), np.eye(3), math.atan(0.1) * 2)
        pictures.append(canvas.render(camera, (200, 200)).astype(int))
    whole, cut = pictures
    assert near(cut[:, 122:], PAPER).all() and not near(whole[:, 122:], PAPER).any()
    assert np.array_equal(cut[:, :118], whole[:, :118]) and near(cut, SHADOW).sum() > 500


def test_a_closing_without_the_law_has_no_panel_of_lambda(run, closing):
    trace = dataclasses.replace(closing.trace, blend=torch.full_like(closing.trace.blend, math.nan))
    other = dataclasses.replace(closing, trace=trace)
    both = [picture(draw_film(run.mesh, run.hand, c, (1.0, 0.0, 0.3))) for c in (closing, other)]
    assert both[1].shape[0] < both[0].shape[0]


def test_trials_that_ended_at_once_or_diverged_have_a_film(run, closing):
    names = ("time", "forces", "object_pose", "hand_pose", "joints", "targets")
    first = {name: getattr(closing, name)[:1] for name in names}
    trace = ClosingTrace(
        *(getattr(closing.trace, f.name)[:1] for f in dataclasses.fields(ClosingTrace))
    )
    none = torch.full((3,), math.nan, dtype=F64)
    stuck = lost(closing, Status.START_OVERLAP, **first, trace=trace, phases=none, contact_order=())
    joints = closing.joints.clone()
    joints[-1] = math.nan
    for closure in (stuck, lost(closing, Status.UNSTABLE, joints=joints)):
        assert draw_film(run.mesh, run.hand, closure, (1.0, 0.0, 0.3))
        assert closure.status.sentence in describe_film(run.mesh, run.hand, closure)


def test_the_plots_have_the_forces_and_motions_of_the_closing(run, closing):
    plots = {
        title.split(" [")[0]: lines for title, _, lines in _list_plots(run.mesh, run.hand, closing)
    }
    for (values, _, label), force in zip(
        plots["normal force"], closing.forces.numpy().T, strict=True
    ):
        np.testing.assert_array_equal(values, force)
        assert label.split(". ")[1] in run.hand.tips.names
    moved = {label: values for values, _, label in plots["motion"]}
    np.testing.assert_allclose(
        moved["object from its place"], 1e3 * closing.object_pose[:, 2, 3], atol=1e-9
    )
    assert np.isnan(moved["object in the hand since pressed"][:50]).all()
