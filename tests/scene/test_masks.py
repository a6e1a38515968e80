import dataclasses
import functools

import numpy as np
import pytest
import torch
from PIL import Image

from tests.make import box, see
from torchgrasp import Scene, read_scene, save_scene
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.cloud.safe_files import read_image_file
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.scene.masks import read_labels, read_mask, read_told_labels

LABELS = np.array([[0, 0, 2, 2], [1, 1, 0, 2], [1, 0, 0, 0]])
SHAPE = LABELS.shape


def run_lengths(mask):
    """Return COCO's run lengths, column by column, from the first run of zeros."""
    flat = np.concatenate([[False], mask.T.ravel(), [not mask.T.ravel()[-1]]])
    edges = np.concatenate([[0], np.nonzero(flat[1:] != flat[:-1])[0]])
    return np.diff(edges).tolist()


def as_text(counts):
    """Return COCO's text of run lengths."""
    text = ""
    for k, count in enumerate(counts):
        value = count - counts[k - 2] if k > 2 else count
        while True:
            bits = value & 31
            value = value >> 5
            more = value != (-1 if bits & 16 else 0)
            text += chr(48 + bits + 32 * more)
            if not more:
                break
    return text


def masks():
    return [LABELS == 1, LABELS == 2]


COLOURS = np.array([[0, 0, 0], [0, 9, 7], [200, 0, 0]], dtype=np.uint8)[LABELS]


@pytest.mark.parametrize(
    "given",
    [
        *(LABELS.astype(kind) for kind in (np.uint8, np.uint16, np.int32, np.uint32, np.float32)),
        torch.from_numpy(LABELS)[..., None],
        torch.from_numpy(LABELS)[None],
        LABELS[None, None],
        COLOURS,
        np.concatenate([COLOURS, np.full((*SHAPE, 1), 255, dtype=np.uint8)], -1),
        masks(),
        torch.from_numpy(np.stack(masks()))[:, None],
        [{"segmentation": mask, "area": int(mask.sum())} for mask in masks()],
        [{"size": list(SHAPE), "counts": run_lengths(mask)} for mask in masks()],
        [{"size": list(SHAPE), "counts": as_text(run_lengths(mask)).encode()} for mask in masks()],
        {
            "annotations": [
                {"image_id": 7, "segmentation": {"size": list(SHAPE), "counts": run_lengths(mask)}}
                for mask in masks()
            ]
        },
    ],
)
def test_every_form_of_labels_is_the_same(given):
    assert torch.equal(read_labels(given, SHAPE), torch.from_numpy(LABELS))


def test_long_run_lengths_as_text_are_those_as_numbers():
    mask = np.random.default_rng(0).uniform(size=(480, 640)) > 0.999
    mask[100:300, 200:400] = True
    found = read_mask({"size": [480, 640], "counts": as_text(run_lengths(mask))}, mask.shape)
    assert torch.equal(found, torch.from_numpy(mask))


def test_a_small_mask_lies_above_a_large_one():
    large = np.ones(SHAPE, dtype=bool)
    for given in ([LABELS == 1, large], [large, LABELS == 1]):
        assert len(read_labels(given, SHAPE).unique()) == 2


def test_a_transparent_picture_has_no_object_there():
    picture = np.full((*SHAPE, 4), 255, dtype=np.uint8)
    picture[..., 3] = 255 * (LABELS == 2)
    assert torch.equal(read_mask(picture, SHAPE), torch.from_numpy(LABELS == 2))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (LABELS, "2 values beside 0"),
        (np.zeros(SHAPE), "no pixel inside"),
        (0.5 * (LABELS == 1), "whole numbers"),
        (-LABELS, "got -2"),
        (np.ones((4, 3), bool), "got shape"),
        ("mask", "whole numbers"),
        ({"size": [4, 3], "counts": [12]}, "run lengths"),
        ({"size": list(SHAPE), "counts": [1, 2]}, "run lengths"),
        ({"size": list(SHAPE), "counts": "\x7f"}, "run lengths"),
        ({"counts": [12]}, "run lengths"),
        ({"size": list(SHAPE), "counts": [2**62, 2**62, 2**62, 2**62, 12]}, "run lengths"),
        ([LABELS == 1] * 1001, "1001 masks"),
        ([[[1, 2], [1]], [[1]]], "whole numbers"),
        ([{"segmentation": [1, 2, 3, 4]}], "got shape"),
        (
            functools.reduce(lambda inner, _: [{"segmentation": inner}], range(3000), [1]),
            "whole numbers",
        ),
        (
            functools.reduce(lambda inner, _: {"segmentation": inner}, range(3000), [1]),
            "whole numbers",
        ),
    ],
)
def test_a_bad_mask_is_one_sentence(given, message):
    with pytest.raises(BadArgument, match=message) as refused:
        read_mask(given, SHAPE)
    assert "\n" not in str(refused.value)


def test_a_mask_of_object_and_table_is_trimmed_with_a_note():
    pose = look_at(20.0, 45.0, 0.7)
    depth, labels = render_depth(
        [box((0.06, 0.05, 0.1)), box((0.05, 0.05, 0.06), (0.05, 0.14))], pose
    )
    row, column = torch.nonzero(labels == 2).T
    drawn = torch.zeros_like(labels, dtype=torch.bool)
    drawn[row.min() - 9 : row.max() + 9, column.min() - 9 : column.max() + 9] = (
        True  # a box about the object
    )
    masked = Scene.from_depth(depth, INTRINSICS, pose, mask=drawn)
    listed = Scene.from_depth(depth, INTRINSICS, pose, labels=[labels == 1, drawn & (labels != 1)])
    exact = Scene.from_depth(depth, INTRINSICS, pose, labels=labels)
    assert exact.notes == () and listed.things == (1, 2) and masked.target == 1
    for scene, target, name in ((masked, 1, "mask: "), (listed, 2, "mask 2: ")):
        (note,) = scene.notes
        assert note.startswith(name) and note.endswith("pixels lie on the support and were removed")
        removed, seen = (int(word) for word in note.removeprefix(name).split()[::2][:2])
        assert 0.8 < removed / int((drawn & (labels == 0)).sum()) < 1.2 and removed < seen
        own = scene.pixels[scene.rows_of(target)]
        assert float((labels[own[:, 0], own[:, 1]] == 2).double().mean()) > 0.98


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"annotations": [{"image_id": k, "segmentation": masks()[k]} for k in range(2)]},
            "annotations of the images 0, 1",
        ),
        (np.stack([100 * LABELS, 50 * LABELS, 0 * LABELS]), "mask 1 with numbers from 100 to 200"),
        ([LABELS], "mask 1 with numbers from 1 to 2"),
        ([255 * (LABELS == 1) + 3 * (LABELS == 2), LABELS == 2], "mask > 127.*from 3 to 255"),
    ],
)
def test_masks_that_would_be_joined_are_refused(given, message):
    with pytest.raises(BadArgument, match=message):
        read_labels(given, SHAPE)


@pytest.mark.parametrize(("first", "told"), [(0, False), (255, True)])
def test_a_palette_whose_black_is_not_number_0_is_refused(tmp_path, first, told):
    """Programs that reduce colours put white first: its number 0 would be no object."""
    picture = Image.fromarray((LABELS == 1).astype(np.uint8), "P")
    picture.putpalette([first] * 3 + [255 - first] * 3)
    picture.save(tmp_path / "mask.png")
    if told:
        with pytest.raises(BadArgument, match="black has number 1; save it as RGB"):
            read_image_file("mask", tmp_path / "mask.png")
    else:
        assert (read_image_file("mask", tmp_path / "mask.png") == (LABELS == 1)).all()


def test_a_photograph_is_no_mask():
    photograph = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    for given in (photograph, photograph.astype(np.int32) @ [1, 256, 0]):
        with pytest.raises(
            BadArgument, match=r"mask: expected at most 1000 objects, got 4.* as of a photograph"
        ):
            read_mask(given, (60, 80))


TALL = look_at(20.0, 45.0, 0.7)


@functools.cache
def tall(noise: bool):
    """Depth and labels of a tall box, one side of which is seen at a grazing angle, and another."""
    boxes = [box([0.06, 0.06, 0.12]), box([0.06, 0.06, 0.08], [0.02, 0.15])]
    return render_depth(boxes, TALL, noise=noise)


def thinned(step: int, first: int, noise: bool = True):
    """Return depth, labels and intrinsics of each `step`-th row and column from the `first` on."""
    k = INTRINSICS.clone()
    k[:2, 2] -= first
    k[:2] /= step
    depth, labels = (image[first::step, first::step].contiguous() for image in tall(noise))
    return depth, labels, k


# the last has 213 x 160 pixels
@pytest.mark.parametrize(("step", "first"), [(1, 0), (2, 0), (2, 1), (3, 1)])
@pytest.mark.parametrize("label", [1, 2])
def test_a_mask_keeps_its_surface_in_an_image_of_any_size(step, first, label):
    depth, labels, k = thinned(step, first)
    exact = thinned(step, first, noise=False)[0]
    mask = labels == label
    scene = Scene.from_depth(depth, k, TALL, mask=mask, table=0.0)
    kept = scene.pixel_labels == 1
    assert not bool((kept & ~mask).any())
    # not flying, and above the foot
    surface = mask & (depth > 0) & ((depth - exact).abs() < 0.005)
    surface &= scene.table.height(scene.image.points()) > 0.01
    assert int((surface & ~kept).sum()) < 0.01 * int(surface.sum())
    flying = mask & (depth - exact > 0.02)
    assert int((kept & flying).sum()) < 0.005 * int(kept.sum())


@pytest.mark.parametrize(("step", "first"), [(1, 1), (2, 0), (3, 1)])
@pytest.mark.parametrize("label", [1, 2])
def test_a_scene_of_a_mask_is_read_again_as_it_was_saved(tmp_path, step, first, label):
    depth, labels, k = thinned(step, first)
    # whole millimetres, and a table too high: many pixels are at a bound
    counts = (1e3 * depth).round().numpy().astype(np.uint16)
    scene = Scene.from_depth(counts, k, TALL, mask=labels == label, table=0.03)
    again = read_scene(save_scene(scene, tmp_path / "scene.npz"))
    assert dataclasses.replace(again, notes=scene.notes) == scene


def test_labels_of_the_table_and_an_inverted_mask_are_told():
    pose = look_at(20.0, 45.0, 0.7)
    depth, labels = render_depth(
        [box((0.06, 0.05, 0.1)), box((0.05, 0.05, 0.06), (0.05, 0.14))], pose
    )
    for table in (3, 255):  # as OCID, OSD and Isaac Sim have a label for it
        given = torch.where(labels > 0, labels, table)
        scene = Scene.from_depth(depth, INTRINSICS, pose, labels=given)
        assert scene.things == (1, 2)
        assert any(note.startswith(f"mask {table}: ") for note in scene.notes)
        for k in (1, 2):
            seen = int(((labels == k) & (depth > 0)).sum())
            assert int(scene.rows_of(k).sum()) > 0.95 * seen
    assert Scene.from_depth(depth, INTRINSICS, pose, mask=labels == 1).notes == ()
    with pytest.raises(BadArgument, match="this target is the table, as of an inverted mask"):
        Scene.from_depth(depth, INTRINSICS, pose, mask=labels != 1)
    depth, labels = render_depth(
        [box((0.06, 0.05, 0.1)), box((0.2, 0.2, 0.15), (0.05, 0.24))], pose
    )
    told = Scene.from_depth(depth, INTRINSICS, pose, mask=labels != 1).notes
    assert any("is it inverted?" in note for note in told)


@pytest.fixture(scope="module")
def small_and_large():
    """The scene of two boxes, the second of which fills about four times as many pixels."""
    scene = see((0.0, -0.1, 0.04, 0.05), (0.0, 0.1, 0.09, 0.1))
    small, large = (int(scene.rows_of(label).sum()) for label in (1, 2))
    assert 3 * small < large < 6 * small
    return scene


def parts(scene: Scene, *shares: float) -> torch.Tensor:
    """The mask of given shares of the measured pixels of the table, the first and the second box;
    they are the first pixels, column by column.
    """
    mask = torch.zeros_like(scene.pixel_labels, dtype=torch.bool)
    for label, share in enumerate(shares):
        own = (scene.pixel_labels == label) & (scene.image.depth > 0)
        column, row = torch.nonzero(own.T).T
        count = round(share * len(row))
        mask[row[:count], column[:count]] = True
    return mask


def masked(scene: Scene, mask: torch.Tensor) -> Scene:
    """The scene of the same image with a mask of the target."""
    image = scene.image
    return Scene.from_depth(
        image.depth, image.intrinsics, image.obj_from_camera, mask=mask, table=scene.table
    )


@pytest.mark.parametrize(
    ("small", "large", "taken"),
    [
        (0.8, 1.0, {1, 2}),  # most of the small box
        (0.3, 1.0, {2}),
        (1.0, 0.3, {1, 2}),  # it is half of the mask
        (1.0, 0.06, {1}),
    ],
)
def test_a_mask_takes_the_objects_that_it_mostly_covers_or_that_fill_much_of_it(
    small_and_large, small, large, taken
):
    found = masked(small_and_large, parts(small_and_large, 0.0, small, large))
    # a few pixels lie at jumps of depth
    counts = small_and_large.pixel_labels[found.pixel_labels == 1].bincount(minlength=3)
    assert {k for k in (1, 2) if counts[k] > 0.01 * counts.sum()} == taken


@pytest.mark.parametrize(("share", "refused"), [(0.03, True), (0.1, False)])
def test_a_mask_of_the_table_with_a_little_of_an_object_is_refused(small_and_large, share, refused):
    """Half of the measured table is in the mask."""
    table, _, large = small_and_large.pixel_labels[small_and_large.image.depth > 0].bincount()
    mask = parts(small_and_large, 0.5, 0.0, 0.5 * float(table / large) * share / (1 - share))
    if refused:
        with pytest.raises(BadArgument, match=r"mask: .* this target is the table"):
            masked(small_and_large, mask)
    else:
        assert masked(small_and_large, mask).target == 1


@pytest.mark.parametrize(("share", "told"), [(0.03, False), (0.1, True)])
def test_table_in_a_mask_is_told_where_it_is_more_than_a_rim(small_and_large, share, told):
    table, _, large = small_and_large.pixel_labels[small_and_large.image.depth > 0].bincount()
    mask = parts(small_and_large, share * float(large / table), 0.0, 1.0)
    notes = masked(small_and_large, mask).notes
    assert any("lie on the support and were removed" in note for note in notes) == told


def test_a_smaller_mask_lies_above_a_larger_one_and_of_equal_ones_the_last():
    chance = np.random.default_rng(0)
    masks = [chance.random((6, 7)) < share for share in (0.9, 0.2, 0.5, 0.2, 0.7)]
    masks.append(masks[1])
    stack = read_labels(masks, (6, 7)).numpy()
    for place in np.ndindex(6, 7):
        here = [(mask.sum(), -k) for k, mask in enumerate(masks, start=1) if mask[place]]
        assert stack[place] == (-min(here)[1] if here else 0)


def test_a_mask_within_another_one_is_told():
    """Tools that segment parts give a handle within its cup, which is then two objects."""
    whole, part, beside = (np.zeros((20, 20), dtype=bool) for _ in range(3))
    whole[2:18, 2:12] = True
    part[4:9, 3:9] = True
    beside[4:16, 9:19] = True  # a quarter of it is in the first one
    assert read_told_labels([whole, beside], whole.shape)[1] == ()
    assert read_told_labels([part, beside], whole.shape)[1] == ()
    for masks, told in (
        ([whole, part], "mask 1: objects 2 lie within it"),
        ([part, beside, whole], "mask 3: objects 1 lie within it"),
        ([whole, part, np.roll(part, 8, 0)], "mask 1: objects 2, 3 lie within it"),
        ([whole, whole], "mask 1: objects 2 lie within it"),
    ):
        (note,) = read_told_labels(masks, whole.shape)[1]
        assert note.startswith(told) and note.endswith("leave out the masks of its parts")


def test_a_scene_tells_a_mask_within_another_one():
    scene = see((0.0, 0.0, 0.08, 0.1))
    whole = np.zeros(scene.image.depth.shape, dtype=bool)
    rows, columns = scene.pixels[scene.labels == 1].T.numpy()
    whole[rows, columns] = True
    part = whole.copy()
    part[: int(np.median(rows))] = False
    given = scene.image.depth, scene.image.intrinsics, scene.image.obj_from_camera
    cut = Scene.from_depth(*given, labels=[whole, part])
    assert [note for note in cut.notes if "within" in note] == [
        "mask 1: objects 2 lie within it, and count as other objects: leave out the masks of its parts"
    ]
    assert not Scene.from_depth(*given, labels=[whole]).notes
