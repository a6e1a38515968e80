"""Masks and labels of objects from other tools: images, lists of masks, and COCO's run lengths."""

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import ndimage
from torchgrasp.foundation.limits import SHOWN_LETTERS
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import SupportPlane
from torchgrasp.scene.image import IMAGE, DepthImage
from torchgrasp.scene.segment import above_table_not_flying, count_labels, rests_on, segment
from torchgrasp.scene.table_image import TableImage


@dataclasses.dataclass(frozen=True)
class MaskNumbers:
    """Bounds by which given masks and labels of objects are read."""

    most_labels: int = 1000
    """Greatest number of objects. An image of labels with more values is taken for a photograph,
    and refused.
    """
    shown: int = 3
    """Greatest number of names of images that an error shows."""
    least_share: float = 0.05
    """Least share of a mask's measured pixels on objects above the table. A mask with less is
    refused.
    """
    own_share: float = 0.5
    """Least share of a segmented object's pixels that are in the mask. With this share or more, the
    object belongs to the target.
    """
    mask_share: float = 0.3
    """Least share of the mask's pixels above the table that are on one segmented object. With this
    share or more, the object belongs to the target, too.
    """
    low: float = 0.01
    """Height [m] above the support below which a pixel counts as lying on it."""
    rim: int = 4
    """Greatest error [pixels] of the border of a given mask."""
    whole: float = 0.5
    """Share of the image in a mask above which the mask is perhaps inverted."""
    told: float = 0.05
    """Share of a mask's pixels above which their removal is mentioned in a note."""
    thin: float = 0.05
    """Share of a label's pixels at jumps of depth above which its object is a thin bar."""
    reach: float = 0.04
    """Greatest shift of a mask that is tried, as a share of the width of the image. Colour and
    depth that are not aligned differ by 2 % or so.
    """
    gained: float = 0.1
    """Least share of a mask's pixels that a shift brings back onto the object, for a note."""
    nested: float = 0.9
    """Least share of a mask's pixels in another mask for a note: its border may be off a little."""
    fitting: float = 0.85
    """Least share of the shifted mask's pixels that are on the object, for a note. With less, the
    mask has another shape.
    """


MASKS = MaskNumbers()
# red, green and blue of a pixel are told apart in one whole number
COLOUR_PLACES = np.array([1 << 32, 1 << 16, 1])
# COCO's text of run lengths: the letter of 0, bits of a letter, and the most bits of a number
FIRST_LETTER = ord("0")
LETTER_BITS = 5
MOST_BITS = 35


def read_labels(labels: Any, shape: tuple[int, ...], name: str = "labels") -> Int[Tensor, "..."]:
    """Return checked labels in the given shape: whole numbers >= 0, where 0 means no object.

    Args:
        labels: the objects' pixels or points, in one of these forms:
            - numbers of any type in the given shape, or with one more axis of length 1;
            - a picture (h, w, 3 or 4) with a colour for each object, where black and transparent
              mean no object;
            - a list of masks, where a smaller mask lies above a larger one;
            - a mask as COCO's run lengths {"size": [h, w], "counts": ...}, or in a dict as its
              "segmentation";
            - a dict with a list of "annotations".
        shape: shape of the depth (h, w) or of the cloud (n,).
        name: name of the argument in errors.

    Raises `BadArgument` for anything else.
    """
    return read_told_labels(labels, shape, name)[0]


def read_told_labels(
    labels: Any, shape: tuple[int, ...], name: str = "labels"
) -> tuple[Int[Tensor, "..."], tuple[str, ...]]:
    """Return the labels that `read_labels` returns, and notes, a sentence for each mask that others
    cut. The arguments and errors are those of `read_labels`.

    Of a mask within another one, both stay objects. So a mask of a part, such as a handle, cuts its
    object in two.
    """
    if isinstance(labels, Mapping) and "annotations" in labels:
        labels = labels["annotations"]
        _check_one_image(labels, name)
    masks = _masks(labels, shape)
    if masks is None:
        read = _read_one(labels, shape, name)
        if (count := len(read.unique())) > MASKS.most_labels + 1:
            raise BadArgument(
                name, f"{count} values, as of a photograph", f"at most {MASKS.most_labels} objects"
            )
        return read, ()
    if len(masks) > MASKS.most_labels:
        raise BadArgument(name, f"{len(masks)} masks", f"at most {MASKS.most_labels}")
    several = list[Tensor]()
    for k, mask in enumerate(masks, start=1):
        read = _read_one(mask, shape, name)
        inside = read > 0
        if len(values := read[inside].unique()) > 1:
            found = f"mask {k} with numbers from {int(values.min())} to {int(values.max())}"
            whole = "masks of one number beside 0, as mask > 127; labels (h, w); colours (h, w, 3)"
            raise BadArgument(name, found, whole)
        several.append(inside)
    return _stack(several, shape)


def _stack(
    masks: list[Tensor], shape: tuple[int, ...]
) -> tuple[Int[Tensor, "..."], tuple[str, ...]]:
    """Return labels 1, 2, ... of masks, the smaller above the larger, and notes on nested ones."""
    stack = torch.zeros(shape, dtype=torch.long)
    within = dict[int, list[int]]()
    sizes = [int(mask.sum()) for mask in masks]
    # the largest first; of equal ones the last is above
    for k in sorted(range(len(masks)), key=lambda k: (-sizes[k], k)):
        below = count_labels(stack[masks[k]], len(masks) + 1)
        outer = 1 + int(below[1:].argmax())
        if sizes[k] and int(below[outer]) >= MASKS.nested * sizes[k]:
            within.setdefault(outer, []).append(k + 1)
        stack[masks[k]] = k + 1
    notes = list[str]()
    for outer, inner in sorted(within.items()):
        parts = ", ".join(map(str, sorted(inner)))
        found = f"objects {parts} lie within it, and count as other objects"
        notes.append(f"{_mask_name(outer)}: {found}: leave out the masks of its parts")
    return stack, tuple(notes)


def _masks(labels: Any, shape: tuple[int, ...]) -> Any:
    """Return several masks, given as a list or as an array (k, h, w) or (k, 1, h, w); None for
    anything else.

    An array (1, h, w) may be an image of labels, and is no list.
    """
    if isinstance(labels, Tensor | np.ndarray):
        several = len(shape) == 2 and tuple(labels.shape[1:]) in (shape, (1, *shape))
        return labels.reshape(-1, *shape) if several and len(labels) != 1 else None
    # of rows of different length, and of other types
    with contextlib.suppress(ValueError, TypeError, KeyError):
        if len(labels) and (isinstance(labels[0], Mapping) or np.ndim(labels[0]) >= 2):
            return labels
    return None


def _check_one_image(annotations: Any, name: str) -> None:
    """Raise `BadArgument` for COCO's annotations of several images: only one image is this one."""
    if not isinstance(annotations, list | tuple):
        return
    images = {str(one.get("image_id")) for one in annotations if isinstance(one, Mapping)}
    if len(images) > 1:
        shown = ", ".join(sorted(images)[: MASKS.shown])[:SHOWN_LETTERS]
        raise BadArgument(name, f"annotations of the images {shown}", "those of this image alone")


def _read_one(labels: Any, shape: tuple[int, ...], name: str) -> Int[Tensor, "..."]:
    """Return the labels in an array of numbers, a picture of colours, or COCO's run lengths."""
    while isinstance(labels, Mapping) and "segmentation" in labels:
        labels = labels["segmentation"]
    if isinstance(labels, Mapping):
        return _runs(labels, shape, name).long()
    whole = f"whole numbers of shape {tuple(shape)}, one for each pixel or point"
    try:
        read = labels.detach().cpu().numpy() if isinstance(labels, Tensor) else np.asarray(labels)
        numbers = read.astype(np.int64)
        exact = bool((numbers == read).all())
    except (TypeError, ValueError, OverflowError) as error:
        raise BadArgument(name, type(labels).__name__, whole) from error
    # one channel, before or after the image
    if read.shape in ((*shape, 1), (1, *shape), (1, 1, *shape)):
        read = read.reshape(shape)
        numbers = numbers.reshape(shape)
    if len(shape) == 2 and read.shape in ((*shape, 3), (*shape, 4)) and exact:
        colour = numbers[..., :3] * (numbers[..., 3:] > 0) if read.shape == (*shape, 4) else numbers
        return _dense(torch.from_numpy(np.abs(colour) @ COLOUR_PLACES))
    if read.shape != tuple(shape) or not exact:
        raise BadArgument(name, f"shape {read.shape}, {read.dtype}", whole)
    if (numbers < 0).any():
        raise BadArgument(
            name, int(numbers.min()), "labels >= 0; 0 is the table and all that is no object"
        )
    return torch.from_numpy(numbers)


def _dense(values: Tensor) -> Tensor:
    """Return labels 0, 1, ... of values in their order, where 0 stays 0."""
    padded = torch.cat([values.new_zeros(1), values.reshape(-1)])
    return padded.unique(return_inverse=True)[1][1:].reshape(values.shape)


def read_mask(mask: Any, shape: tuple[int, ...]) -> Bool[Tensor, "..."]:
    """Return the boolean mask of one object, True on the object.

    `shape` is that of the depth (h, w) or of the cloud (n,), and of the result. `mask` is an array
    of this shape: one number > 0, such as 1 or 255, on the object, and 0 elsewhere. It may also be
    a picture (h, w, 3 or 4) that is black elsewhere, or COCO's run lengths. Other forms are those
    of `read_labels`. Raises `BadArgument` for anything else, or if it marks no object, or several.
    """
    labels = read_labels(mask, shape, "mask")
    found = labels[labels > 0].unique()
    if not len(found):
        raise BadArgument("mask", "no pixel inside", "a mask that is not 0 at the object's pixels")
    if len(found) > 1:
        raise BadArgument(
            "mask", f"{len(found)} values beside 0", "one object; give several objects as labels"
        )
    return labels > 0


def _runs(mask: Mapping[str, Any], shape: tuple[int, ...], name: str) -> Bool[Tensor, "h w"]:
    """Return the mask that COCO's run lengths describe, column by column; the lengths are numbers
    or text.
    """
    allowed = f'a dict with "size" {list(shape)} and "counts", whose sum is {int(np.prod(shape))}'
    try:
        size = [int(side) for side in mask["size"]]
        counts = mask["counts"]
        if isinstance(counts, str | bytes):
            counts = _run_lengths(counts.encode("ascii") if isinstance(counts, str) else counts)
        runs = np.asarray(counts, dtype=np.int64)
        if (
            size != list(shape)
            or ((runs < 0) | (runs > np.prod(shape))).any()
            or runs.sum() != np.prod(shape)
        ):
            raise ValueError(f"size {size}, sum {runs.sum()}")
    except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise BadArgument(
            name, f"{type(error).__name__} ({error}) in run lengths", allowed
        ) from error
    # every second run is inside
    column = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return torch.from_numpy(column.reshape(shape[::-1]).T.copy())


def _run_lengths(text: bytes) -> list[int]:
    """Return run lengths from COCO's text, 5 bits a letter. From the fourth on, it holds run i
    minus run i - 2.
    """
    more = 1 << LETTER_BITS
    sign = more >> 1
    runs: list[int] = []
    value = 0
    shift = 0
    for letter in text:
        bits = letter - FIRST_LETTER
        if not 0 <= bits < 2 * more or shift > MOST_BITS:
            raise ValueError("a letter that is no run length")
        value |= (bits % more) << shift
        shift += LETTER_BITS
        if bits & more:
            continue
        # the last letter of a number holds its sign
        value -= (1 << shift) if bits & sign else 0
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = 0
        shift = 0
    return runs


def label_image(
    view: TableImage, labels: Int[Tensor, "h w"] | None, mask: Bool[Tensor, "h w"] | None
) -> tuple[Int[Tensor, "h w"], tuple[str, ...]]:
    """Return the label (h, w) of each pixel of a `view`, and notes, a sentence each. `labels`, a
    `mask` or neither may be given, each (h, w).

    Given labels lose pixels on the table and flying pixels. A label that is mostly on the table,
    and keeps under 5 % of its pixels, is removed. Without labels the image is segmented. A mask
    becomes label 1, and loses strips of neighbouring objects, too. Pixels of the mask's object just
    outside of the mask get label 0. A note names each mask that loses more than a twentieth of its
    pixels. Raises `BadArgument` for a mask that keeps under 5 % or under 30 of its measured pixels.
    It is also raised for labels that keep none.
    """
    if labels is not None:
        return _trim_labels(view, labels)
    objects = segment(view)
    if mask is None:
        return objects, ()
    inside = mask & _on_objects(view, mask.long())
    # objects that the mask shows, or that fill much of it, belong to the target
    length = int(objects.max()) + 1
    whole = count_labels(objects, length)
    part = count_labels(torch.where(inside, objects, 0), length)
    shown = part >= MASKS.own_share * whole
    belongs = shown | (part >= MASKS.mask_share * max(1, int(inside.sum())))
    belongs[0] = True
    target = inside & belongs[objects]
    seen = int((mask & view.measured).sum())
    if int(target.sum()) < max(IMAGE.least_pixels, MASKS.least_share * seen):
        found = f"{int(target.sum())} of {seen} measured pixels above the table"
        share = f"a {1 / MASKS.least_share:.0f}th"
        least = f"at least {IMAGE.least_pixels}, and {share}: this target is the table"
        if float(mask.double().mean()) > MASKS.whole:
            least += ", as of an inverted mask"
        raise BadArgument("mask", found, least)
    rest = _dense(_beside(objects, target, mask, belongs))
    low = mask & ~inside & _on_support(view)
    flying = mask & ~inside & view.measured & ~low
    strips = inside & ~target
    notes = [
        *_removed("mask", int(low.sum()), seen),
        *_removed("mask", int(strips.sum()), seen, "another object"),
        *_removed("mask", int(flying.sum()), seen, "no surface, between near and far ones,"),
    ]
    share = float(mask.double().mean())
    if share > MASKS.whole and 2 * int(low.sum()) > seen:
        notes.append(
            f"mask: it marks {share:.0%} of the image, mostly the support: is it inverted?"
        )
    elif notes:
        notes += _shifted(mask & view.measured, target | (shown[objects] & (objects > 0)))
    return torch.where(target, 1, torch.where(rest > 0, rest + 1, 0)), tuple(notes)


def _trim_labels(
    view: TableImage, labels: Int[Tensor, "h w"]
) -> tuple[Int[Tensor, "h w"], tuple[str, ...]]:
    """Return given labels without pixels on the table and flying pixels, and a note on each label
    that loses many.
    """
    kept = torch.where(_on_objects(view, labels), labels, 0)
    names, own = labels.unique(return_inverse=True)
    lost = count_labels(own[_on_support(view) & (kept == 0)], len(names))
    seen = count_labels(own[view.measured], len(names))
    notes = list[str]()
    left = count_labels(own[kept > 0], len(names))
    for k, *counts, rest in zip(*(x.tolist() for x in (names, lost, seen, left)), strict=True):
        if k > 0:
            notes += _removed(_mask_name(k), *counts)
        # as given masks of one object: this one is the table
        if k > 0 and 0 < rest < MASKS.least_share * counts[1] and 2 * counts[0] > counts[1]:
            notes.append(
                f"{_mask_name(k)}: its other {rest} pixels were removed, too: it is the support"
            )
            kept = torch.where(kept == k, 0, kept)
    if not (kept > 0).any():
        raise BadArgument(
            "labels", "none that rises above the table", "labels of objects on the table"
        )
    return kept, tuple(notes)


def without_masks(notes: tuple[str, ...], labels: tuple[int, ...]) -> tuple[str, ...]:
    """Return those `notes` of `label_image` that do not tell of pixels removed from one of
    `labels`.
    """
    heads = tuple(f"{_mask_name(label)}:" for label in labels)
    return tuple(note for note in notes if not note.startswith(heads))


def label_again(
    image: DepthImage,
    former: Plane,
    support: SupportPlane,
    labels: Int[Tensor, "h w"],
    given: tuple[int, ...],
    first: int,
) -> Int[Tensor, "h w"]:
    """Return the label (h, w) of each pixel of a depth image after another support has replaced its
    former table.

    The new `support` and the `former` table are in the frame of the image's pose. Labels that the
    user gave (`given`) lose pixels on the support. They gain pixels of their objects that the
    former table hid. Other objects are segmented again, and each keeps the label of most of its
    former pixels. New objects get new labels. The label `first` is assigned before the others.
    `labels` (h, w) are the labels until now.
    """
    view = TableImage.of(image, support)
    before = TableImage(image, view.points, SupportPlane(former))
    own = torch.isin(labels, torch.tensor(given, dtype=torch.long))
    # a support takes no pixel from which it has moved away
    away = view.height >= before.height
    kept = torch.where(own & (_on_objects(view, labels) | away), labels, 0)
    found = segment(view)
    seen = rests_on(before)
    width = int(found.max()) + 1
    names, row = labels.unique(return_inverse=True)
    # (former label, label found): the pixels that they share
    shared = count_labels((row * width + found)[seen], len(names) * width)
    shared = shared.reshape(len(names), width)
    shared[:, 0] = 0
    number = torch.arange(width) + names[-1]
    belongs = torch.zeros(width, dtype=torch.bool)
    for k in sorted(range(len(names)), key=lambda k: int(names[k]) != first):
        if int(names[k]) in given:
            mine = 2 * shared[k] > shared.sum(0)
            kept = torch.where(~seen & mine[found] & (kept == 0), names[k], kept)
            belongs |= mine
        elif names[k] > 0 and 2 * int(shared[k].max()) > int((labels == names[k]).sum()):
            best = shared[k].argmax()
            number[best] = torch.where(number[best] > names[-1], names[k], number[best])
    if own.any() and not (labels[~own] > 0).any():
        return kept
    found = _beside(found, kept > 0, own, belongs)
    return torch.where(kept > 0, kept, torch.where(found > 0, number[found], 0))


def _beside(objects: Tensor, target: Tensor, mask: Tensor, belongs: Tensor) -> Int[Tensor, "h w"]:
    """Return labels without the target, strips of its object around `mask`, and specks: these
    become 0.
    """
    about = torch.from_numpy(ndimage.binary_dilation(mask.numpy(), iterations=MASKS.rim))
    rest = torch.where(target | (about & belongs[objects]), 0, objects)
    few = count_labels(rest, len(belongs)) < IMAGE.least_pixels
    return torch.where(few[rest], 0, rest)


def _on_objects(view: TableImage, labels: Int[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Return a mask of the pixels on the surface of an object.

    Labels with many pixels at jumps of depth are those of thin bars, and keep these pixels. Labels
    that lose the other pixels lose none when they are read again.
    """
    sure = rests_on(view)
    beside = above_table_not_flying(view) & ~sure
    names, own = labels.unique(return_inverse=True)
    more = count_labels(own[beside], len(names))
    thin = more > MASKS.thin * (more + count_labels(own[sure], len(names)))
    return sure | (thin[own] & beside)


def _on_support(view: TableImage) -> Bool[Tensor, "h w"]:
    """Return a mask of the measured pixels that lie on the plane of the support or below it."""
    return view.measured & (view.height < MASKS.low)


def _shifted(mask: Bool[Tensor, "h w"], target: Bool[Tensor, "h w"]) -> list[str]:
    """Return a list with one sentence if the mask fits its object better elsewhere; else an empty
    one.

    A mask from a colour image that is not aligned with the depth lies beside its object.
    """
    from scipy import signal

    reach = math.ceil(MASKS.reach * mask.shape[1])
    padded = np.pad(target.numpy(), reach).astype(float)
    # entry (down, right) counts the pixels on the object after such a shift, from -reach on
    counts = signal.correlate(padded, mask.double().numpy(), mode="valid", method="fft")
    shares = torch.from_numpy(counts.round()) / int(mask.sum())
    best = int(shares.argmax())
    gained = float(shares.max() - shares[reach, reach])
    if gained < MASKS.gained or float(shares.max()) < MASKS.fitting:
        return []
    down, right = (k - reach for k in divmod(best, 2 * reach + 1))
    place = [
        f"{abs(count)} {'pixel' if abs(count) == 1 else 'pixels'} {after if count > 0 else before}"
        for count, before, after in ((right, "left", "right"), (down, "up", "down"))
        if count
    ]
    return [f"mask: it fits its object {' and '.join(place)}: align it with the depth image"]


def _mask_name(label: int) -> str:
    """Return the name of the mask of a label in notes."""
    return f"mask {label}"


def _removed(mask: str, count: int, seen: int, where: str = "the support") -> list[str]:
    """Return a list with one sentence that `count` of `seen` pixels were removed from a mask. It is
    empty if they are few.
    """
    if count <= MASKS.told * seen:
        return []
    return [f"{mask}: {count} of {seen} pixels lie on {where} and were removed"]
