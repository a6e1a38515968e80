"""Self-collision of a hand by capsules and boxes: the signed least distance over a fixed list of pairs.

The capsules lose up to 4 mm at the corners of box-shaped links and bulge by 1 mm at their flat sides. Against exact
convex hulls they agree on 96 % of postures.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.hand.collide import box_distance, segment_distance
from torchgrasp.hand.kinematics import placed
from torchgrasp.hand.spec import HandSpec
from torchgrasp.hand.urdf import Urdf

CAPSULE_POINTS = 4
"""Points on a capsule's axis at which its distance from a box is taken."""


@dataclasses.dataclass(frozen=True)
class SelfCollision(Value):
    """Capsules (axis from `start` to `end`, `radius`), boxes, and the pairs of them to test, in link frames [m]."""

    capsule_link: Int[Tensor, " c"]
    start: Float[Tensor, "c 3"]
    end: Float[Tensor, "c 3"]
    radius: Float[Tensor, " c"]
    box_link: Int[Tensor, " x"]
    box_center: Float[Tensor, "x 3"]
    box_half: Float[Tensor, "x 3"]
    capsule_pairs: Int[Tensor, "p 2"]
    box_pairs: Int[Tensor, "q 2"]

    def clearance(self, poses: Float[Tensor, "n l 4 4"]) -> Float[Tensor, " n"]:
        """Return the signed least distance [m] over all pairs; infinite for a hand without pairs."""
        least = poses.new_full((len(poses),), torch.inf)
        for distances in (self.capsule_distances(poses), self.box_distances(poses)):
            if len(distances):
                least = torch.minimum(least, distances.amin(0))
        return least

    def axes(self, poses: Float[Tensor, "n l 4 4"]) -> tuple[Float[Tensor, "n c 3"], Float[Tensor, "n c 3"]]:
        """Return the ends of the capsules' axes in the palm's frame [m]."""
        start, end = self._columns(poses)
        return start.permute(2, 1, 0), end.permute(2, 1, 0)

    def _columns(self, poses: Float[Tensor, "n l 4 4"]) -> tuple[Float[Tensor, "3 c n"], Float[Tensor, "3 c n"]]:
        """Return the ends of the capsules' axes coordinate by coordinate, rows last: the fast layout here."""
        frames = _frames(poses, self.capsule_link)
        return placed(frames, self.start), placed(frames, self.end)

    def capsule_distances(self, poses: Float[Tensor, "n l 4 4"]) -> Float[Tensor, "p n"]:
        """Return the signed distance of each pair of capsules."""
        start, end = self._columns(poses)
        i, j = self.capsule_pairs.unbind(1)
        radius = self.radius.to(poses)
        a, b, c, d = (x.index_select(1, k).movedim(0, -1) for k in (i, j) for x in (start, end))
        return segment_distance(a, b, c, d) - (radius[i] + radius[j])[:, None]

    def box_distances(self, poses: Float[Tensor, "n l 4 4"]) -> Float[Tensor, "q n"]:
        """Return the signed distance of each capsule from each box, at points along the capsule's axis."""
        i, j = self.box_pairs.unbind(1)
        frames = _frames(poses, self.box_link)
        origin = placed(frames, self.box_center)
        start, end = (x.index_select(1, i) - origin.index_select(1, j) for x in self._columns(poses))
        turn = frames[:, :3].index_select(2, j)
        start, end = (turn[0] * x[0] + turn[1] * x[1] + turn[2] * x[2] for x in (start, end))  # in the box's frame
        half, least = self.box_half.to(poses)[j].T[:, :, None], None
        for along in (k / (CAPSULE_POINTS - 1) for k in range(CAPSULE_POINTS)):
            point = (start + along * (end - start)).movedim(0, -1)
            distance = box_distance(point, half.expand_as(start).movedim(0, -1))
            least = distance if least is None else torch.minimum(least, distance)
        assert least is not None
        return least - self.radius.to(poses)[i][:, None]


def _frames(poses: Float[Tensor, "n l 4 4"], link: Int[Tensor, " c"]) -> Float[Tensor, "3 4 c n"]:
    """Select link poses with every matrix entry's rows contiguous in memory."""
    return poses[..., :3, :].permute(2, 3, 1, 0).contiguous().index_select(2, link)


def self_collision_from_spec(urdf: Urdf, spec: HandSpec) -> SelfCollision:
    """List the capsule-capsule and capsule-box pairs of the link pairs that hand.toml names.

    Without a list every pair of links is tested but those that share a joint.
    """
    links = {x.name: i for i, x in enumerate(urdf.links)}
    if spec.pairs is None:
        names = sorted(links)
        neighbours = {frozenset((j.parent, j.child)) for j in urdf.joints}
        tested = {frozenset((a, b)) for a in names for b in names if a < b} - neighbours
    else:
        tested = {frozenset(pair) for pair in spec.pairs}
    capsules, boxes = spec.capsules, spec.boxes
    capsule_pairs = [
        [i, j]
        for i in range(len(capsules))
        for j in range(i + 1, len(capsules))
        if frozenset((capsules[i].link, capsules[j].link)) in tested
    ]
    box_pairs = [
        [i, j]
        for i in range(len(capsules))
        for j in range(len(boxes))
        if frozenset((capsules[i].link, boxes[j].link)) in tested
    ]
    return SelfCollision(
        capsule_link=torch.tensor([links[c.link] for c in capsules], dtype=torch.long),
        start=torch.tensor([c.a for c in capsules], dtype=torch.float64).reshape(-1, 3),
        end=torch.tensor([c.b for c in capsules], dtype=torch.float64).reshape(-1, 3),
        radius=torch.tensor([c.radius for c in capsules], dtype=torch.float64),
        box_link=torch.tensor([links[b.link] for b in boxes], dtype=torch.long),
        box_center=torch.tensor([b.center for b in boxes], dtype=torch.float64).reshape(-1, 3),
        box_half=torch.tensor([b.size for b in boxes], dtype=torch.float64).reshape(-1, 3) / 2,
        capsule_pairs=torch.tensor(capsule_pairs, dtype=torch.long).reshape(-1, 2),
        box_pairs=torch.tensor(box_pairs, dtype=torch.long).reshape(-1, 2),
    )
