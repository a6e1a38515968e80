"""A scene: objects on a table, as one camera saw them, from images and clouds."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.depth import tell_step
from torchgrasp.cloud.pose import (
    check_sizes,
    find_plausible,
    tell_furniture,
    tell_layer,
    tell_tilt,
)
from torchgrasp.cloud.rays import tell_rays
from torchgrasp.cloud.sensor import SensorNoise, estimate_noise
from torchgrasp.foundation.base import Value, kept, settle
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, NoSupport
from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.foundation.rules import Pose, Positive
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.linalg import Points, norm
from torchgrasp.geometry.plane import Plane, to_upright
from torchgrasp.geometry.support_planes import SUPPORTS, SupportPlane
from torchgrasp.geometry.support_search import Target, find_table
from torchgrasp.scene.creases import cut_creases
from torchgrasp.scene.image import (
    DepthImage,
    find_nearest,
    image_of_cloud,
    read_image,
)
from torchgrasp.scene.leaning import tell_leaning
from torchgrasp.scene.masks import label_image, read_labels, read_mask, read_told_labels
from torchgrasp.scene.merge import find_touching
from torchgrasp.scene.segment import find_components
from torchgrasp.scene.table_image import TableImage
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class SceneNumbers:
    """Bounds by which clicked pixels, points and parts of objects are found in a scene."""

    front: float = 0.01
    """Distance [m] of a point behind its pixel's depth from which on it belongs to something
    hidden.
    """
    click: float = 3.0
    """Largest distance [px] of a clicked pixel from a measured one."""
    touch: float = 0.01
    """Largest distance [m] of a given point from a measured one."""
    part: float = 0.1
    """Least share of an object's pixels beyond a crease at which a note says that they may be
    another object.
    """
    apart: float = 0.2
    """Least share of an object's pixels before or behind a jump of depth at which a note says that
    they may be another object.
    """
    across: float = 0.19
    """Distance [m] between a target's two farthest points from which on a note says that it may be
    several objects. Hands grasp few objects that are longer.
    """
    filled: float = 0.85
    """Share of the convex hull of its pixels that a long target (`across`) fills. With less, it may
    be several objects.
    """
    closing: int = 2
    """Number of pixels by which gaps in a target are closed before the share `filled` is measured.
    """
    lowest: float = 0.02
    """Share of a target's points that may be lower than its foot: outliers."""
    drawn: int = 2000
    """Greatest number of points of a target whose place on a support is judged."""
    beside: float = 6.0
    """Greatest distance [px] of an object's pixels from the outline of a target that it covers:
    rims have no label.
    """
    before: float = 0.01
    """Least distance [m] in front of the target of an object that covers it: objects beside it
    cover nothing.
    """
    covered: float = 0.2
    """Share of the target's outline that one object covers, above which advice names it. Then a
    fifth of the target is usually hidden.
    """


SCENE = SceneNumbers()
Guess = tuple[tuple[int, ...], str]
"""Labels of objects whose outlines are guesses, and a sentence that says why."""
LOCAL = (
    "the support is bowed or small: its plane was fitted to a part of it, and holds near that part"
)


@checked
@dataclasses.dataclass(frozen=True)
class Scene(Value):
    """Objects on a table, as one camera saw them. `plan_scene` plans grasps of its target.

    `Scene.from_depth`, `Scene.from_cloud`, `read_scene` and `load_scene` return scenes. Points and
    planes are in the frame "obj", in which the camera has the pose `obj_from_camera`.

    Attributes:
        points: the n measured points (n, 3) [m].
        labels: label (n,) of each point: 1, 2, ... for the objects, 0 for the table and everything
            else.
        image: the camera's depth image. Its fields are `depth` (h, w) [m], `intrinsics` (3, 3)
            [pixels] and `obj_from_camera` (4, 4) [m]. The depth is 0 where nothing was measured.
            Its field `bounded` is False if the image was rendered from a cloud, and so has no true
            border.
        pixels: row and column (n, 2) of each point in the image.
        table: the plane that the objects stand on, or None if it is unknown.
        target: label of the object to be grasped, or None if none is chosen.
        others: other planes that objects could stand on, the more plausible first.
        notes: what was changed or is doubtful, a sentence each. Examples are pixels removed from a
            given mask or label, or a table or a camera in an unlikely place.
        given: labels of objects whose pixels the user gave, as labels or as a mask. The library
            found the other objects.

    >>> from torchgrasp import load_scene
    >>> target = load_scene().select([394, 312])  # a clicked pixel: column, row
    >>> target.target in target.things, len(target.cloud()) == int(target.rows_of().sum())
    (True, True)
    """

    points: Float[Tensor, "n 3"]
    labels: Int[Tensor, "n"]
    image: DepthImage
    pixels: Int[Tensor, "n 2"]
    table: Plane | None = None
    target: int | None = None
    others: tuple[Plane, ...] = ()
    notes: tuple[str, ...] = ()
    given: tuple[int, ...] = ()

    @classmethod
    @checked
    def from_depth(
        cls,
        depth: Tensor | np.ndarray,
        intrinsics: object,
        camera_pose: Tensor | np.ndarray | None = None,
        *,
        mask: Tensor | np.ndarray | Sequence[Any] | Mapping[str, Any] | None = None,
        labels: Tensor | np.ndarray | Sequence[Any] | Mapping[str, Any] | None = None,
        point: Sequence[float | int] | Tensor | np.ndarray | None = None,
        table: Plane | float | None = None,
        up: Sequence[float | int] | Tensor | np.ndarray | None = None,
        depth_unit: Positive | None = None,
    ) -> "Scene":
        """Return the scene that a pinhole camera's depth image shows.

        The objects are those of `labels`. Without labels they are the connected components above
        the table. Pixels on the table get the label 0. So do flying pixels, which lie between a
        near and a far surface. A `mask` or a `point` chooses the target; without both there is
        none. Points, planes and directions are in the frame "obj", to which `camera_pose` leads.

        Args:
            depth: image (h, w) of depths, as `cloud_from_depth` takes it: floats in metres, or
                integers in millimetres.
            intrinsics: matrix (3, 3) or (fx, fy, cx, cy) [pixels], or another form that
                `cloud_from_depth` takes, without distortion.
            camera_pose: rigid pose `obj_from_camera` (4, 4) [m]; None means that "obj" is the
                camera's frame (x right, y down, z forward).
            mask: image (h, w), not 0 at the target's pixels; its border may be a few pixels off.
                Or any form of `labels` that marks one object.
            labels: the objects' pixels, in one of these forms:
                - an image (h, w) of whole numbers, where 0 means no object;
                - a picture (h, w, 3 or 4) with a colour for each object, where black and
                  transparent mean no object;
                - a list of masks, where a smaller mask lies above a larger one. A note tells of
                  a mask within another one, which is perhaps a part of it;
                - COCO's run lengths {"size": [h, w], "counts": ...}, or COCO's dict with a list of
                  "annotations".
            point: a place on the target, as a pixel (u, v), column first, or a point (x, y, z) [m].
            table: a plane, or its height [m] along z; None means that it is fitted to the points.
            up: direction (3,) against gravity; the normal of a fitted table is within 30 degrees
                of it. None allows any direction, but prefers z if there is a `camera_pose`.
            depth_unit: metres of one count of the depth. None means metres for floats. For integers
                it means the depth_scale of the intrinsics, else millimetres.

        Raises:
            BadArgument: what `cloud_from_depth` refuses, and an image with distortion.
            BadArgument: fewer than 30 measured pixels (`IMAGE.least_pixels`).
            BadArgument: mask or labels of another size; a mask beside labels or a point.
            BadArgument: a mask or labels on the table alone; a point on no object.
            BadArgument: a camera below a given table, or `up` over 60 degrees from its normal.
            BadArgument: a pose or a unit that the view contradicts.
            NoSupport: no plane is found on which objects stand.
        """
        if sum(given is not None for given in (mask, labels, point)) > 1 and mask is not None:
            raise BadArgument("mask", "a mask beside labels or a point", "one of them")
        image = read_image(depth, intrinsics, camera_pose, depth_unit)
        inside = None if mask is None else read_mask(mask, tuple(image.depth.shape))
        given = None
        nested = ()
        if labels is not None:
            given, nested = read_told_labels(labels, tuple(image.depth.shape))
        points = image.points()
        measured = image.depth > 0
        try:
            supports = find_plausible(
                points[measured],
                image.obj_from_camera,
                table,
                up,
                depth_unit is not None,
                _target(points[measured], None if inside is None else inside[measured]),
            )
        except NoSupport as error:
            if rays := tell_rays(image.depth, image.intrinsics):
                raise NoSupport("table", error.found, f"{error.allowed}; {rays[0]}") from None
            raise
        found, notes = label_image(TableImage(image, points, supports[0]), given, inside)
        notes = (*nested, *notes)
        if table is None and depth_unit is None:
            notes += check_sizes(
                points[measured], found[measured], image.obj_from_camera, supports[0].plane
            )
        if table is None:
            notes += tell_furniture(points[measured], found[measured])
        if table is not None:
            notes += tell_layer(points[measured], supports[0].plane)
        bowed = table is None and supports[0].local
        notes += (LOCAL,) * bowed
        tilted = table is None and up is None
        tilt = tell_tilt(image.obj_from_camera, supports[0].plane) if tilted else ()
        if bowed or tilt:
            notes += tell_rays(image.depth, image.intrinsics)
        notes += tilt
        notes += tell_step(image.depth)
        notes += tell_leaning(
            points[measured],
            found[measured],
            image.obj_from_camera,
            supports[0].plane,
        )
        pixels = torch.nonzero(measured)
        planes = tuple(support.plane for support in supports)
        scene = cls(
            points[measured], found[measured], image, pixels, planes[0], None, planes[1:], notes
        )
        return scene._chosen(given is not None, inside is not None, point)

    @classmethod
    @checked
    def from_cloud(
        cls,
        cloud: PointCloud,
        *,
        labels: Tensor | np.ndarray | None = None,
        mask: Tensor | np.ndarray | None = None,
        box: Tensor | np.ndarray | Sequence[Sequence[float | int]] | None = None,
        point: Sequence[float | int] | Tensor | np.ndarray | None = None,
        table: Plane | float | None = None,
        up: Sequence[float | int] | Tensor | np.ndarray | None = None,
    ) -> "Scene":
        """Return the scene that a point cloud of one view shows.

        The points are projected to a depth image of a pinhole camera at the cloud's viewpoint. The
        objects are those of `labels`. Without labels they are the connected components above the
        table. A `mask`, a `box` or a `point` chooses the target; without them there is none. The
        frame of the cloud is "obj".

        Args:
            cloud: everything that the camera saw, n points [m], with the camera's viewpoint (3,).
            labels: whole numbers (n,), one for each point; 0 means no object.
            mask: mask (n,), not 0 at the points of the target.
            box: two opposite corners (2, 3) [m] of a box along the axes of the cloud's frame, which
                holds the target.
            point: a place on the target, as a point (x, y, z) [m] in the cloud's frame.
            table: a plane, or its height [m] along z; None means that it is fitted to the points.
            up: direction (3,) against gravity; the normal of a fitted table is within 30 degrees
                of it. None allows any direction.

        Raises:
            BadArgument: no viewpoint or several; points all around the camera.
            BadArgument: labels or a mask of another size; a mask or box without points. Also a mask
                of fractions, or of several values beside 0.
            BadArgument: more than one of labels, mask and box; a mask or box beside a point; a
                pixel as the point.
            BadArgument: a target, a table or a direction that `from_depth` refuses.
            NoSupport: no plane is found on which objects stand.

        >>> from torchgrasp import PointCloud, load_scene
        >>> seen = load_scene()
        >>> len(Scene.from_cloud(PointCloud(seen.points, viewpoint=seen.viewpoint)).things) > 1
        True
        """
        if sum(given is not None for given in (labels, mask, box)) > 1:
            raise BadArgument("mask", "several of mask, labels and box", "one of them")
        if point is not None and (mask is not None or box is not None):
            raise BadArgument("point", "a point beside a mask or a box", "one of them")
        if point is not None and np.shape(np.asarray(point)) == (2,):
            raise BadArgument(
                "point", "a pixel of a cloud, which has none", "a point (x, y, z) [m]"
            )
        if cloud.viewpoint is None or cloud.viewpoint.ndim != 1:
            found = "none" if cloud.viewpoint is None else "one for each point"
            raise BadArgument("viewpoint", found, "the position of the one camera")
        points = cloud.points.detach().cpu().double()
        viewpoint = cloud.viewpoint.detach().cpu().double()
        given = None if labels is None else read_labels(labels, (len(points),))
        inside = None if mask is None else read_mask(mask, (len(points),))
        if box is not None:
            corners = torch.as_tensor(np.asarray(box), dtype=torch.float64)
            if corners.shape != (2, 3):
                raise BadArgument("box", f"shape {tuple(corners.shape)}", "two corners (2, 3)")
            inside = ((points >= corners.amin(0)) & (points <= corners.amax(0))).all(-1)
            if not inside.any():
                raise BadArgument("box", "no point inside", "one that holds the target")
        supports = find_table(points, viewpoint, table, up, _target(points, inside))
        planes = tuple(support.plane for support in supports)
        image, pixels = image_of_cloud(points, viewpoint, planes[0].normal.double())
        row, column = pixels.unbind(-1)
        depth = ((points - viewpoint) @ image.obj_from_camera[:3, 2]) - image.depth[row, column]
        front = depth < SCENE.front

        def to_image(values: Tensor | None) -> Tensor | None:
            if values is None:
                return None
            whole = torch.zeros(image.depth.shape, dtype=values.dtype)
            whole[row[front], column[front]] = values[front]
            return whole

        view = TableImage.of(image, supports[0])
        found, notes = label_image(view, to_image(given), to_image(inside))
        own = torch.where(front, found[row, column], 0)
        scene = cls(points, own, image, pixels, planes[0], None, planes[1:], notes)
        return scene._chosen(given is not None, inside is not None, point)

    def _chosen(self, labelled: bool, masked: bool, point: Any) -> "Scene":
        """Return the scene with the target that a mask or a point chooses. It has the labels that
        the user gave.
        """
        given = self.things if labelled else ()
        scene = dataclasses.replace(self, given=given)
        if masked:
            scene = dataclasses.replace(self, target=1, given=(1,))
        scene = scene if point is None else scene.select(point)
        return dataclasses.replace(scene, notes=(*scene.notes, *scene._afloat()))

    def _afloat(self) -> tuple[str, ...]:
        """Return a note if the target is far above its table, as above a floor or before a wall."""
        if self.target is None or self.table is None:
            return ()
        height = self.table.height(self.points[self.rows_of()].double())
        foot = float(height.quantile(SCENE.lowest))
        if foot <= SUPPORTS.afloat:
            return ()
        where = f"the target begins {foot:.2f} m from the plane that is taken for its table"
        return (f"{where}, which may be a floor or a wall: give the table",)

    @checked
    def select(self, target: int | Sequence[float | int] | Tensor | np.ndarray) -> "Scene":
        """Return the scene with another target.

        Args:
            target: a label of `things`, or a pixel (u, v) of the image, column first. Or a point
                (x, y, z) [m] in the frame "obj".

        For a pixel or a point, the target is the object of the nearest measured point.

        Raises `BadArgument` if that point is on no object, or farther than 3 pixels (`SCENE.click`)
        or 10 mm (`SCENE.touch`). It is also raised for a label that is not in `things`.
        """
        if isinstance(target, int) and not isinstance(target, bool):
            if target not in self.things:
                raise BadArgument("target", target, f"a label of an object: {list(self.things)}")
            return self._aimed(target)
        place = torch.as_tensor(np.asarray(target), dtype=torch.float64)
        if place.shape not in ((2,), (3,)) or not torch.isfinite(place).all():
            raise BadArgument("point", repr(target), "a pixel (u, v) or a point (x, y, z)")
        if len(place) == 2:
            offset = self.pixels.double() - place.flip(0)
            reach = SCENE.click
            text = f"pixel ({place[0]:g}, {place[1]:g})"
        else:
            offset = self.points.double() - place
            reach = SCENE.touch
            text = f"point ({', '.join(f'{x:.3f}' for x in place.tolist())}) m"
        distance = norm(offset)
        nearest = int(distance.argmin())
        if float(distance[nearest]) > reach:
            raise BadArgument("point", f"nothing measured at {text}", "a place on an object")
        label = int(self.labels[nearest])
        if label == 0:
            raise BadArgument(
                "point", f"{text} on the table, or on no object", "a place on an object"
            )
        return self._aimed(label)

    def _aimed(self, target: int) -> "Scene":
        """Return the scene with another target; the borders of its objects are searched once."""
        scene = dataclasses.replace(self, target=target)
        # borders do not depend on the target
        vars(scene)["_source"] = vars(self).get("_source", self)
        return scene

    @property
    def advice(self) -> tuple[str, ...]:
        """Problems of the scene with their fixes, a sentence each; empty if there are none.

        The problems are:

        * Objects could also stand on another plane than `table`.
        * Two objects touch, so that the border between them is a guess. It is no guess if the user
          gave the pixels of both (`given`).
        * An object that the library found has a crease: it may be several objects.
        * A target that the library found has a jump in depth: it may be several objects.
        * A target that the library found is long, and has gaps in its outline: it may be several
          objects.
        * The target is cut off at the border of the image.
        * Another object hides much of the target.
        * The target has `doubts`, so the predicted success is unknown.
        """
        found = [
            f"objects could also stand on another plane ({plane.describe()}); "
            "give it as the table to choose it"
            for plane in self.others
        ]
        found += [sentence for _, sentence in self._guesses]
        if self.image.at_border(self.pixels[self.rows_of()]):
            fix = "its other part is unknown; turn the camera to it"
            found.append(f"the target is cut off at the border of the image: {fix}")
        for k, share in self.covers.items():
            fix = f"turn the camera, or take object {k} away first"
            found.append(f"object {k} stands before {share:.0%} of the target's outline: {fix}")
        if self.doubts:
            found.append(
                "the target's outline is a guess, so its success is unknown: give its mask"
            )
        return tuple(found)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons why the target may be several objects, or a part of one, a sentence each.

        They are the sentences of `advice` on creases, jumps in depth, gaps in the outline, and
        touching objects. There are none without a target. There are also none if the user gave the
        target's pixels (`given`): the outline is then no guess.
        """
        # the search for guesses goes over the whole image
        if self.target is None or self.target in self.given:
            return ()
        return tuple(sentence for labels, sentence in self._guesses if self.target in labels)

    @kept
    def _borders(self) -> "_Borders":
        """The borders of the objects, which are the same for every target."""
        source: Scene | None = vars(self).get("_source")
        return _Borders.of(settle(self, torch.device("cpu"))) if source is None else source._borders

    @kept
    def _guesses(self) -> tuple[Guess, ...]:
        """The labels of objects whose outlines are guesses, each time with a sentence that says
        why.
        """
        found = list[Guess]()
        borders = self._borders
        labels = borders.labels
        for a, b in borders.touching:
            if a in self.given and b in self.given:
                continue
            text = f"objects {a} and {b} touch, and their border is a guess: "
            found.append(((a, b), text + "give a mask of the one to grasp"))
        several = ": if it is several objects, give a mask of the one to grasp"
        for k in (k for k in self.things if k not in self.given):
            sizes = borders.parts[labels == k].unique(return_counts=True)[1]
            if int((sizes > SCENE.part * sizes.sum()).sum()) > 1:
                found.append(((k,), f"object {k} has a crease{several}"))
            elif k == self.target and borders.jump_in(k):
                found.append(((k,), f"the target has a jump in depth{several}"))
            elif k == self.target and settle(self, labels.device)._sprawls(labels):
                found.append(((k,), f"the target is long and has gaps in its outline{several}"))
        return tuple(found)

    def _sprawls(self, labels: Int[Tensor, "h w"]) -> bool:
        """Return whether the target is long, and does not fill the convex hull of its pixels."""
        points = self.points[self.rows_of()].double()
        end = points[norm(points - points.mean(0)).argmax()]
        other = points[norm(points - end).argmax()]
        if float(norm(points - other).max()) < SCENE.across:
            return False
        closed = ndimage.binary_closing(
            (labels == self.target).cpu().numpy(), iterations=SCENE.closing
        )
        pixels = np.argwhere(closed)
        try:
            hull = spatial.ConvexHull(pixels)
        except spatial.QhullError:  # a line of pixels has no gap
            return False
        return len(pixels) < SCENE.filled * float(hull.volume)

    @property
    def covers(self) -> dict[int, float]:
        """The objects that hide much of the target: a dict from each object's label to a share in
        [0, 1].

        The share is the part of the target's outline that this object stands in front of. Only
        shares above a fifth (`SCENE.covered`) are listed. Without a target the dict is empty.
        """
        labels = self.pixel_labels.cpu()
        depth = self.image.depth.cpu().double()
        own = labels == (self.target or 0)
        others = (labels > 0) & ~own
        if self.target is None or not others.any():
            return {}
        inner: Any = ndimage.binary_erosion(own.numpy())
        outline = own & ~torch.from_numpy(inner)
        gap, nearest = find_nearest(others)
        before = depth - depth.reshape(-1)[nearest] > SCENE.before
        whose = labels.reshape(-1)[nearest][outline & before & (gap <= SCENE.beside)]
        covering, pixels = whose.unique(return_counts=True)
        shares = (pixels / outline.sum()).tolist()
        pairs = zip(covering.tolist(), shares, strict=True)
        return {k: share for k, share in pairs if share > SCENE.covered}

    @property
    def pixel_labels(self) -> Int[Tensor, "h w"]:
        """The label (h, w) of each pixel of the image: 1, 2, ... for the objects, 0 elsewhere.

        It is 0 on the table, and where no depth was measured.
        """
        height, width = self.image.depth.shape
        row, column = self.pixels.long().unbind(-1)
        labels = self.labels.new_zeros(height * width)
        # points that a nearer one in the same pixel hides have label 0
        labels.scatter_reduce_(0, row * width + column, self.labels, "amax")
        return labels.reshape(height, width)

    @property
    def supports(self) -> tuple[Plane, ...]:
        """The planes that objects could stand on: `table`, then `others`; empty if no table is
        known.
        """
        return () if self.table is None else (self.table, *self.others)

    @property
    def noise(self) -> SensorNoise | None:
        """The noise of the camera's depths, estimated from the pixels that show the table.

        It is a `torchgrasp.cloud.SensorNoise`, whose fields `floor` [m], `growth` [1/m] and `bias`
        [m] are estimated. None if no table is known, or if fewer than 1000 pixels show the table.
        """
        if self.table is None:
            return None
        image = self.image
        rows = self.pixels[self.labels == 0]
        on_table = torch.zeros(image.depth.shape, dtype=torch.bool)
        on_table[rows[:, 0], rows[:, 1]] = True
        return estimate_noise(
            image.depth,
            image.intrinsics,
            self.table.moved(inverse(image.obj_from_camera)),
            on_table,
        )

    @property
    def viewpoint(self) -> Float[Tensor, "3"]:
        """The camera's position (3,) [m] in the frame "obj"."""
        return self.image.obj_from_camera[:3, 3]

    @property
    def things(self) -> tuple[int, ...]:
        """The labels of the objects, ascending, without 0."""
        return tuple(k for k in self.labels.unique().tolist() if k > 0)

    @checked
    def rows_of(self, label: int | None = None) -> Bool[Tensor, "n"]:
        """Return a mask (n,) of the points of one object.

        Args:
            label: the object's label; None means the target.

        The mask is all False for a label without points, and for None without a target.
        """
        label = self.target if label is None else label
        return (
            torch.zeros_like(self.labels, dtype=torch.bool)
            if label is None
            else self.labels == label
        )

    @checked
    def cloud(self, label: int | None = None) -> PointCloud:
        """Return the points (n, 3) [m] of one object, with the camera as viewpoint.

        They are in the scene's frame, in which the camera has the pose `image.obj_from_camera`. All
        objects of the scene share this frame.

        Args:
            label: the object's label; None means the target.

        Raises `BadArgument` for a label without points, or for None without a target. Raises
        `TooFewPoints` for fewer than 4 points.
        """
        rows = self.rows_of(label)
        frustum = self.image.frustum
        if not rows.any():
            found = f"{label if label is not None else self.target}, of which no point is seen"
            raise BadArgument("label", found, f"one of {list(self.things)}")
        sides = None if frustum is None else frustum.to(self.points)
        return PointCloud(self.points[rows], None, self.viewpoint.to(self.points), sides)

    @checked
    def to_upright(self, obj_from_upright: Pose) -> "Scene":
        """Return the scene in an upright frame, in which the table is the plane z = 0.

        Coordinates of points are rounded to multiples of 2^-20 m, about a micrometre. Numbers of
        the camera's pose are rounded to multiples of 2^-30. `others` is empty.

        Args:
            obj_from_upright: pose (4, 4) [m] of the upright frame in the frame "obj". Its z axis
                must be the table's normal, and its origin on the table. This is not checked.

        Raises `BadArgument` for a transform that is not rigid.
        """
        obj_from_upright = obj_from_upright.double()
        return dataclasses.replace(
            self,
            points=to_upright(self.points, obj_from_upright),
            image=self.image.to_upright(obj_from_upright),
            table=None if self.table is None else Plane.horizontal(0.0),
            others=(),
        )


@dataclasses.dataclass(frozen=True)
class _Borders:
    """Where the objects of a scene may end: the places at which they touch, creases and jumps.

    Attributes:
        labels: label (h, w) of each pixel of the scene.
        view: the scene's image above its table.
        touching: pairs of labels of objects that touch.
        parts: number (h, w) of the part, between creases, to which each object's pixel belongs.
    """

    labels: Int[Tensor, "h w"]
    view: TableImage
    touching: tuple[tuple[int, int], ...]
    parts: Int[Tensor, "h w"]

    @classmethod
    def of(cls, scene: Scene) -> "_Borders":
        """Return the borders of the objects of a scene on the CPU."""
        view = TableImage.of(scene.image, SupportPlane(scene.table or Plane.horizontal(0.0)))
        labels = scene.pixel_labels
        touching = find_touching(scene.image, view.points, labels)
        return cls(labels, view, tuple(touching), cut_creases(scene.image, view.points, labels))

    def jump_in(self, label: int) -> bool:
        """Return whether large parts of an object's pixels lie apart in depth."""
        smooth = self.view.smooth
        own = self.labels == label
        parts = find_components(smooth, own & smooth.measured)
        sizes = parts[parts > 0].unique(return_counts=True)[1]
        return int((sizes > SCENE.apart * int(own.sum())).sum()) > 1


def _target(points: Points, inside: Tensor | None) -> Target | None:
    """Return the target that a mask shows, `inside` (n,) of the `points` (n, 3) [m], or None."""
    if inside is None or not inside.any():
        return None
    own = points[inside]
    return Target(own[:: 1 + len(own) // SCENE.drawn])
