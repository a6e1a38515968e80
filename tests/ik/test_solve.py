"""From contacts to postures: held-out postures are found again, in any frame; what cannot be
reached says so.
"""

import pytest
import torch

from tests.make import near, real, touched_contacts
from torchgrasp import Contacts, load_hand, load_mixture, sample_configurations, solve_ik
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply, rigid, rotate, rotation_from_vector, virtual_frame
from torchgrasp.ik import CollisionWorld, PostureLibrary, nearest_postures
from torchgrasp.ik.cobyla import refine_by_cobyla
from torchgrasp.ik.configuration import Configuration


def four_fingers():
    """The Allegro with all fingers, its postures, and contacts of other postures with their fingers
    mixed up.
    """
    hand = load_hand("allegro", 4)
    contacts = touched_contacts(hand, sample_configurations(hand, 12, seed=5).joints)
    order = torch.stack(
        [torch.randperm(4, generator=torch.Generator().manual_seed(k)) for k in range(12)]
    )
    at = torch.arange(12)[:, None]
    return (
        hand,
        PostureLibrary.of(hand, 2000),
        Contacts(contacts.points[at, order], contacts.normals[at, order]),
    )


def test_contacts_of_four_fingers_are_solved_in_any_order():
    hand, library, contacts = four_fingers()
    solution = solve_ik(hand, contacts, library=library)
    assert float((solution.status == Status.OK).double().mean()) >= 0.9
    solved = solution.status == Status.OK
    near(solution.tip_error, miss(hand, solution, contacts), 1e-9)
    assert float(solution.tip_error[solved].max()) < 1e-3
    assert bool((solution.permutation.sort(1).values == torch.arange(4)).all())
    for options, word in (
        ({"method": "cobyla"}, "method"),
        ({"mixture": load_mixture("allegro")}, "mixture"),
    ):
        with pytest.raises(BadArgument, match=rf"{word}: expected three fingertips.*4 fingertips"):
            solve_ik(hand, contacts, library=library, **options)
    with pytest.raises(BadArgument, match=r"contacts\.points"):
        solve_ik(load_hand("allegro"), contacts)


@pytest.fixture(scope="module", params=["allegro", "barrett"])
def scene(request):
    """A hand, its model, its own postures, and contacts that 10 postures of another seed touch."""
    hand = load_hand(request.param)
    contacts = touched_contacts(hand, sample_configurations(hand, 10, seed=5).joints)
    return hand, load_mixture(request.param), PostureLibrary.of(hand), contacts


def miss(hand, solution, contacts):
    """The distance of each round tip's surface point from its contact [m], by the hand's public
    functions alone.
    """
    at = torch.arange(len(contacts))[:, None]
    points = contacts.points[at, solution.permutation]
    normals = contacts.normals[at, solution.permutation]
    centres = apply(solution.obj_from_hand, hand.tip_centres(solution.joints))
    return (centres - hand.tips.radius[:, None] * normals - points).norm(dim=-1)


@pytest.mark.parametrize("learned", [True, False])
def test_codes_of_real_postures_are_solved(scene, learned):
    hand, mixture, library, contacts = scene
    solution = solve_ik(hand, contacts, mixture if learned else None, library=library)
    assert (solution.status == Status.OK).all()
    near(solution.tip_error, miss(hand, solution, contacts), 1e-9)
    assert float(solution.tip_error.max()) < 1e-3
    assert float(solution.tip_error.amax(1).median()) < 5e-5
    assert bool((hand.self_clearance(solution.joints) >= 0).all())
    hand.check_joints(solution.joints)
    assert bool((solution.attempts >= 1).all())
    again = solve_ik(hand, contacts, mixture if learned else None, library=library)
    assert torch.equal(solution.joints, again.joints)


def test_the_frame_of_the_contacts_does_not_matter(scene):
    hand, mixture, library, contacts = scene
    turn = rotation_from_vector(real([0.4, -1.0, 2.0]))
    move = rigid(turn, real([0.5, -0.2, 0.1]))
    some = contacts[:6]
    moved = Contacts(apply(move, some.points), rotate(move, some.normals))
    here, there = (solve_ik(hand, x, mixture, library=library) for x in (some, moved))
    near(here.joints, there.joints, 1e-6)
    near(move @ here.obj_from_hand, there.obj_from_hand, 1e-6)


def test_cobyla_moves_pose_and_joints_until_the_contact_points_meet():
    hand = load_hand("barrett")
    true = real([[0.3, 0.9, 1.0, 0.8], [0.1, 1.2, 0.6, 1.0]])
    points, normals = hand.fingertips(true)
    contacts = Contacts(points, -normals)
    nowhere = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    solution = refine_by_cobyla(
        hand, Configuration(true + 0.05, nowhere), contacts, CollisionWorld()
    )
    tips = hand.fingertips(solution.joints)[0]
    assert float((apply(solution.obj_from_hand, tips) - points).norm(dim=-1).max()) < 1e-4
    near(solution.obj_from_hand @ virtual_frame(tips), virtual_frame(points), 1e-9)
    hand.check_joints(solution.joints)
    by_name = solve_ik(hand, contacts[:1], load_mixture("barrett"), method="cobyla")
    assert by_name.status[0] == Status.OK


def test_a_table_is_kept_clear_of(scene):
    hand, mixture, library, contacts = scene
    height = float(contacts.points[..., 2].min()) - 0.005
    solution = solve_ik(hand, contacts[:6], mixture, CollisionWorld(table=height), library=library)
    good = solution.status == Status.OK
    cover = hand.collision_spheres
    lowest = (
        apply(solution.obj_from_hand, hand.sphere_centres(solution.joints))[..., 2] - cover.radius
    ).amin(1)
    assert bool(good.any()) and bool((lowest[good] >= height).all())
    assert bool((solution.status[~good] >= Status.OUT_OF_REACH).all())


def test_rows_without_a_posture_say_so(scene):
    hand, mixture, library, contacts = scene
    flat = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]).double()
    far = 100 * contacts.points[0]
    points = torch.stack([flat, far, contacts.points[1]])
    given = Contacts(points, contacts.normals[:3])
    solution = solve_ik(hand, given, mixture, library=library)
    assert solution.status.tolist() == [Status.DEGENERATE, Status.TIP_ERROR, Status.OK]
    assert bool(solution.joints[0].isnan().all()) and not bool(solution.joints[1:].isnan().any())
    assert len(solve_ik(hand, given[:0], mixture, library=library)) == 0


def test_bad_arguments_are_named(scene):
    hand, mixture, library, contacts = scene
    nan = Contacts(contacts.points * torch.nan, contacts.normals)
    with pytest.raises(BadArgument, match=r"contacts\.points"):
        solve_ik(hand, nan, mixture, library=library)
    # the centre of a round tip would be as many radii off the surface
    long = Contacts(contacts.points, 3 * contacts.normals)
    with pytest.raises(BadArgument, match=r"contacts\.normals: expected unit vectors"):
        solve_ik(hand, long, mixture, library=library)
    with pytest.raises(BadArgument, match=r"contacts\.normals: expected unit vectors"):
        nearest_postures(library, long, CollisionWorld())
    with pytest.raises((BadArgument, TypeError), match="method"):
        solve_ik(hand, contacts, mixture, method="newton", library=library)  # pyright: ignore
    other = load_mixture("barrett" if hand.name == "allegro" else "allegro")
    with pytest.raises(BadArgument, match="mixture"):
        solve_ik(hand, contacts, other, library=library)
