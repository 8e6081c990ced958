"""The motion of a scene, and how a point that is seen in any frame finds what it follows."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.geometry import quaternion_to_matrix
from lerobot_msdyn.motion.model.binding import nearest_parts
from lerobot_msdyn.motion.model.compose import Level, compose, compose_points
from lerobot_msdyn.motion.spec import Binding, first_level, level_spec

_VOTERS = 5  # tracks that decide the part of a point
_CHUNK = 4096  # points whose distances to all tracks are held at a time
_INVERSIONS = 4  # steps in which a point is traced back to the canonical frame


Bindings = tuple[tuple[Int[Tensor, "n _"], ...], tuple[Float[Tensor, "n _"], ...]]  # indices and logits per level


@dataclass(frozen=True)
class SceneMotion:
    """The levels of motion, and the tracks by which points find what they follow."""

    names: tuple[str, ...]  # coarse to fine
    levels: tuple[Level, ...]
    canonical_frame: int
    points: Float[Tensor, "n 3"]  # m, tracked points at the canonical frame
    part: Int[Tensor, " n"]  # basis of the first level that each follows
    instance: Int[Tensor, " n"]
    blend_parts: int = 1  # parts that a point follows at the first level, if that is one of rigid parts
    blend_reach: float = 0.1  # see `MotionConfig`

    @property
    def is_rigid(self) -> bool:
        """Whether every point follows one rigid motion alone."""
        return len(self.levels) == 1 and first_level(self.names[0]).rigid and self.blend_parts == 1

    def bind(self, points: Float[Tensor, "m 3"], part: Int[Tensor, " m"]) -> Bindings:
        """Indices and logits, per level, of canonical points (m) of known parts."""
        indices, logits = bind(self.names, self.levels, points, part)
        if self.blend_parts == 1 or not first_level(self.names[0]).rigid:
            return indices, logits
        followed, weights = nearest_parts(
            points, part, self.points, self.part, self.instance, self.blend_parts, self.blend_reach
        )
        return (followed, *indices[1:]), (weights, *logits[1:])

    def moved(
        self, points: Float[Tensor, "m 3"], part: Int[Tensor, " m"], times: Tensor
    ) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 4"]]:
        """Where canonical points (m) are at some times (frames), and how far they have turned (wxyz)."""
        return compose(points, unturned(len(points)), self.levels, *self.bind(points, part), times)

    def moved_points(
        self, points: Float[Tensor, "m 3"], part: Int[Tensor, " m"], times: Tensor
    ) -> Float[Tensor, "b m 3"]:
        """Where canonical points (m) are at some times (frames)."""
        return compose_points(points, self.levels, *self.bind(points, part), times)

    def to_canonical(
        self, points: Float[Tensor, "m 3"], frame: int, instance: Int[Tensor, " m"]
    ) -> tuple[Float[Tensor, "m 3"], Int[Tensor, " m"]]:
        """Where world points (m) seen at a frame are at the canonical one, and their parts.

        The part is that of most of the five nearest tracks of the same instance. All tracks take part, where the
        motion has carried them, whether or not they are seen at that frame; points of an instance without tracks go
        by the nearest tracks of any. From the nearest track of that part a point is traced back by Newton steps, with
        the motion's rotation for its Jacobian.
        """
        at = torch.tensor([frame])
        tracked, turned = (each[0] for each in self.moved(self.points, self.part, at))
        part = torch.zeros(len(points), dtype=torch.long)
        nearest = torch.zeros(len(points), dtype=torch.long)
        for label in instance.unique():
            rows = (instance == label).nonzero()[:, 0]
            tracks = (self.instance == label).nonzero()[:, 0]
            if len(tracks) == 0:
                tracks = torch.arange(len(self.points))
            for chunk in rows.split(_CHUNK):
                part[chunk], nearest[chunk] = self._vote(points[chunk], tracked[tracks], tracks)
        back = quaternion_to_matrix(turned).transpose(1, 2)[nearest]
        x = self.points[nearest] + (back @ (points - tracked[nearest])[..., None])[..., 0]
        for _ in range(0 if self.is_rigid else _INVERSIONS):
            y, turn = (each[0] for each in self.moved(x, part, at))
            x = x + (quaternion_to_matrix(turn).transpose(1, 2) @ (points - y)[..., None])[..., 0]
        return x, part

    def _vote(
        self, points: Float[Tensor, "m 3"], tracked: Float[Tensor, "n 3"], tracks: Int[Tensor, " n"]
    ) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
        """Part of each point, and the nearest track of that part."""
        distance, near = torch.cdist(points, tracked).topk(min(_VOTERS, len(tracked)), largest=False)
        votes = torch.zeros(len(points), int(self.part.max()) + 1)
        part = votes.scatter_add_(1, self.part[tracks][near], 1 / distance.clamp(min=1e-6)).argmax(dim=1)
        first = (self.part[tracks][near] == part[:, None]).int().argmax(dim=1, keepdim=True)
        return part, tracks[near.gather(1, first)[:, 0]]


def bind(
    names: tuple[str, ...], levels: tuple[Level, ...], points: Float[Tensor, "n 3"], part: Int[Tensor, " n"]
) -> Bindings:
    """Indices and logits, per level, of canonical points (m) of known parts."""
    bindings: list[Binding] = []
    for name, level in zip(names, levels, strict=True):
        bindings.append(level_spec(name).bind(level, points, part, bindings[-1] if bindings else None))
    return tuple(index for index, _ in bindings), tuple(logit for _, logit in bindings)


def unturned(count: int) -> Float[Tensor, "n 4"]:
    """Quaternions (wxyz) of no rotation."""
    return torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
