"""Self-collision of a hand by capsules and boxes: the signed least distance over a fixed list of pairs.

The capsules lose up to 4 mm at the corners of box-shaped links and bulge by 1 mm at their flat sides. Against exact
convex hulls they agree on 96 % of postures.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.hand.collide import box_distance, segment_distance
from torchgrasp.hand.spec import HandSpec
from torchgrasp.hand.urdf import Urdf
from torchgrasp.values import Value

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
        capsules, boxes = self.capsule_distances(poses), self.box_distances(poses)
        for distances in (capsules, boxes):
            if distances.shape[1]:
                least = torch.minimum(least, distances.amin(1))
        return least

    def axes(self, poses: Float[Tensor, "n l 4 4"]) -> tuple[Float[Tensor, "n c 3"], Float[Tensor, "n c 3"]]:
        """Return the ends of the capsules' axes in the palm's frame."""
        frames = poses[:, self.capsule_link]
        rotation, origin = frames[..., :3, :3], frames[..., :3, 3]
        start, end = self.start.to(poses)[:, :, None], self.end.to(poses)[:, :, None]
        return (rotation @ start)[..., 0] + origin, (rotation @ end)[..., 0] + origin

    def capsule_distances(self, poses: Float[Tensor, "n l 4 4"]) -> Float[Tensor, "n p"]:
        """Return the signed distance of each pair of capsules."""
        start, end = self.axes(poses)
        i, j = self.capsule_pairs.unbind(1)
        radius = self.radius.to(poses)
        return segment_distance(start[:, i], end[:, i], start[:, j], end[:, j]) - radius[i] - radius[j]

    def box_distances(self, poses: Float[Tensor, "n l 4 4"]) -> Float[Tensor, "n q"]:
        """Return the signed distance of each capsule from each box, at points along the capsule's axis."""
        start, end = self.axes(poses)
        i, j = self.box_pairs.unbind(1)
        frames = poses[:, self.box_link[j]]
        along = torch.linspace(0, 1, CAPSULE_POINTS, dtype=poses.dtype, device=poses.device)[:, None]
        points = start[:, i, None] + along * (end - start)[:, i, None]
        local = (points - frames[:, :, None, :3, 3]) @ frames[..., :3, :3] - self.box_center.to(poses)[j, None]
        distance = box_distance(local, self.box_half.to(poses)[j, None].expand_as(local))
        return distance.amin(-1) - self.radius.to(poses)[i]


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
    real = {"dtype": torch.float64}
    return SelfCollision(
        capsule_link=torch.tensor([links[c.link] for c in capsules], dtype=torch.long),
        start=torch.tensor([c.a for c in capsules], **real).reshape(-1, 3),
        end=torch.tensor([c.b for c in capsules], **real).reshape(-1, 3),
        radius=torch.tensor([c.radius for c in capsules], **real),
        box_link=torch.tensor([links[b.link] for b in boxes], dtype=torch.long),
        box_center=torch.tensor([b.center for b in boxes], **real).reshape(-1, 3),
        box_half=torch.tensor([b.size for b in boxes], **real).reshape(-1, 3) / 2,
        capsule_pairs=torch.tensor(capsule_pairs, dtype=torch.long).reshape(-1, 2),
        box_pairs=torch.tensor(box_pairs, dtype=torch.long).reshape(-1, 2),
    )
