import numpy as np
import trimesh

from torchgrasp.app.report.canvas import frame_camera, sharp_normals
from torchgrasp.app.report.raster import Camera, Triangles, concatenate, render

WHITE = (1.0, 1.0, 1.0)
RED = (1.0, 0.0, 0.0)
BLUE = (0.0, 0.0, 1.0)
NONE = concatenate([])
LOOK = Camera(np.array([0.0, 0.0, 2.0]), np.eye(3), float(np.deg2rad(40.0)))


def flat(corners, color, lit=False):
    corners = np.asarray(corners, dtype=float)
    normals = np.broadcast_to((0.0, 0.0, 1.0), corners.shape)
    return Triangles(
        corners, normals, np.broadcast_to(color, corners.shape), np.full(len(corners), lit)
    )


def square(z, half, color):
    a = (-half, -half, z)
    b = (half, -half, z)
    c = (half, half, z)
    d = (-half, half, z)
    return flat([[a, b, c], [a, c, d]], color)


def test_a_ball_covers_the_disc_that_perspective_says():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    picture = render(flat(ball.vertices[ball.faces], RED), NONE, LOOK, (300, 300), WHITE)
    # The cone that touches a ball of radius r at distance d has the half angle asin(r / d).
    radius = 150 / np.tan(np.deg2rad(20.0)) * np.tan(np.arcsin(0.4 / 2.0))
    assert np.isclose(
        (255 - picture[..., 1].astype(float)).sum() / 255, np.pi * radius**2, rtol=0.005
    )


def test_a_point_lands_on_its_pixel():
    picture = render(square(0.0, 0.01, RED), NONE, LOOK, (301, 201), WHITE)
    rows, columns = np.nonzero(picture[..., 1] < 255)
    assert (rows.mean(), columns.mean()) == (100.0, 150.0)
    shifted = Camera(LOOK.position - np.array([0.2, 0.1, 0.0]), LOOK.frame, LOOK.angle)
    rows, columns = np.nonzero(
        render(square(0.0, 0.01, RED), NONE, shifted, (301, 201), WHITE)[..., 1] < 255
    )
    focal = 201 / 2 / np.tan(np.deg2rad(20.0))
    np.testing.assert_allclose(
        [columns.mean() - 150, 100 - rows.mean()], [focal * 0.1, focal * 0.05], atol=0.5
    )


def test_triangles_that_share_edges_leave_no_crack_and_the_nearer_wins():
    rng = np.random.default_rng(0)
    xy = np.concatenate([rng.uniform(-2, 2, (200, 2)), [[-2, -2], [2, -2], [2, 2], [-2, 2]]])
    from scipy.spatial import Delaunay

    corners = np.concatenate([xy, np.zeros((len(xy), 1))], 1)[Delaunay(xy).simplices]
    picture = render(
        concatenate([flat(corners, RED), square(-0.5, 3.0, BLUE)]), NONE, LOOK, (120, 90), WHITE
    )
    assert (picture == (255, 0, 0)).all()
    picture = render(
        concatenate([flat(corners, RED), square(0.5, 3.0, BLUE)]), NONE, LOOK, (120, 90), WHITE
    )
    assert (picture == (0, 0, 255)).all()


def test_a_sheer_layer_is_blended_only_in_front():
    front = render(square(0.0, 3.0, RED), square(0.5, 3.0, BLUE), LOOK, (20, 20), WHITE)
    behind = render(square(0.0, 3.0, RED), square(-0.5, 3.0, BLUE), LOOK, (20, 20), WHITE)
    np.testing.assert_allclose(
        front.astype(int), np.broadcast_to((128, 0, 128), front.shape), atol=1
    )
    assert (behind == (255, 0, 0)).all()


def test_nothing_is_the_background():
    assert (render(NONE, NONE, LOOK, (8, 6), BLUE) == (0, 0, 255)).all()


def test_colours_are_interpolated_in_space_not_on_the_screen():
    """Half-way between corners at distances 1 and 3, the colour is the mean, though not half-way on
    the screen.
    """
    corners = np.array(
        [
            [[-0.3, -0.4, 1.0], [0.9, -0.4, -1.0], [0.9, 0.4, -1.0]],
            [[-0.3, -0.4, 1.0], [0.9, 0.4, -1.0], [-0.3, 0.4, 1.0]],
        ]
    )
    red = (corners[..., :1] - -0.3) / 1.2
    colors = np.concatenate([red, np.zeros((2, 3, 2))], -1)
    triangles = Triangles(
        corners, np.broadcast_to((0.0, 0.0, 1.0), corners.shape), colors, np.zeros(2, dtype=bool)
    )
    picture = render(triangles, NONE, LOOK, (400, 300), WHITE)
    column = 200 + int(150 / np.tan(np.deg2rad(20.0)) * 0.3 / 2.0)
    assert abs(int(picture[150, column, 0]) - 128) <= 2


def test_a_lit_surface_is_brighter_towards_the_key_lamp():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    corners = ball.vertices[ball.faces]
    lit = Triangles(
        corners, corners / 0.4, np.full(corners.shape, 0.5), np.ones(len(corners), dtype=bool)
    )
    picture = render(lit, NONE, LOOK, (200, 200), WHITE).astype(int)[..., 0]
    assert picture[80, 80] > picture[120, 120] + 10


def test_normals_are_sharp_on_a_box_and_smooth_on_a_ball():
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    faces = np.asarray(box.faces)
    np.testing.assert_allclose(
        sharp_normals(np.asarray(box.vertices), faces),
        np.repeat(box.face_normals[:, None], 3, 1),
        atol=1e-12,
    )
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    smooth = sharp_normals(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert ((smooth * ball.vertices[ball.faces]).sum(-1) > 0.999).all()


def test_the_frame_holds_every_corner():
    rng = np.random.default_rng(1)
    for direction in ((1.0, 0.0, 0.0), (0.3, -0.2, 0.9), (0.0, 0.0, 1.0), (-1.0, 2.0, -3.0)):
        for drop in (0.0, 0.09):
            corners = rng.normal(size=(200, 3)) * (0.05, 0.1, 0.2) + (1.0, 2.0, 3.0)
            camera = frame_camera(corners, direction, drop)
            local = (corners - camera.position) @ camera.frame.T
            up = -local[:, 1] / local[:, 2] / np.tan(camera.angle / 2)
            side = -local[:, 0] / local[:, 2] / np.tan(camera.angle / 2) * 720 / 900
            assert (
                (local[:, 2] < 0).all()
                and (np.abs(side) < 1).all()
                and (up < 1).all()
                and (up > -1 + 2 * drop).all()
            )
            assert np.abs(np.concatenate([side, up])).max() > 0.6
