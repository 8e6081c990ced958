"""From tracks to the object level of motion: lift, choose a canonical frame, split into rigid parts, fit each."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.geometry import invert_se3, transform_points
from lerobot_msdyn.motion.bases import MotionLevel, carried, identity_level, level_from_motions
from lerobot_msdyn.motion.gaps import STILL, fill_gaps, find_carriers
from lerobot_msdyn.motion.lift import lift_tracks
from lerobot_msdyn.motion.parts import split_rigid_parts
from lerobot_msdyn.motion.rigid import fit_rigid, model_points
from lerobot_msdyn.priors.types import PointTracks

_MIN_SEEN = 3  # frames, and 5 % of the clip, in which a track must be seen
_MIN_SEEN_SHARE = 0.05
_MAX_TRACKS = 1500  # of an instance that are used, the longest ones
_VOTERS = 5  # tracks that decide the part of a point
_CHUNK = 4096  # points whose distances to all tracks are held at a time


@dataclass(frozen=True)
class ObjectMotion:
    """The object level: one rigid motion per part, and the tracks by which points find their part."""

    level: MotionLevel
    canonical_frame: int
    points: Float[Tensor, "n 3"]  # m, tracked points at the canonical frame
    part: Int[Tensor, " n"]  # index of the basis that each follows
    instance: Int[Tensor, " n"]

    def assign(self, points: Float[Tensor, "m 3"], frame: int, instance: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
        """Part of world points (m) seen at a frame: that of most of the five nearest tracks of the same instance.

        All tracks take part, where their part has carried them, whether or not they are seen at that frame. Points
        of an instance without tracks go by the nearest tracks of any.
        """
        moved = carried(self.level, self.part, self.points, frame)
        out = torch.zeros(len(points), dtype=torch.long)
        for label in instance.unique():
            rows = (instance == label).nonzero()[:, 0]
            tracks = (self.instance == label).nonzero()[:, 0]
            if len(tracks) == 0:
                tracks = torch.arange(len(self.points))
            for some in rows.split(_CHUNK):
                out[some] = self._vote(points[some], moved[tracks], self.part[tracks])
        return out

    def _vote(
        self, points: Float[Tensor, "m 3"], tracked: Float[Tensor, "n 3"], part: Int[Tensor, " n"]
    ) -> Int[Tensor, " m"]:
        distance, nearest = torch.cdist(points, tracked).topk(min(_VOTERS, len(tracked)), largest=False)
        votes = torch.zeros(len(points), len(self.level))
        return votes.scatter_add_(1, part[nearest], 1 / distance.clamp(min=1e-6)).argmax(dim=1)


def object_motion(
    tracks: PointTracks, depth: Float[Tensor, "t h w"], camera: CameraTrack, max_parts: int
) -> ObjectMotion | None:
    """Motion of everything that was tracked, or None where nothing was.

    Args:
        tracks: points followed in the image.
        depth: z-depth in m, 0 = unknown.
        camera: the camera that saw both.
        max_parts: bound on the rigid parts of one instance.
    """
    xyz, valid = lift_tracks(tracks, depth, camera)
    kept = _longest(valid, tracks.instance)
    if len(kept) == 0:
        return None
    xyz, valid = xyz[kept], valid[kept]
    confidence, instance = tracks.confidence[kept], tracks.instance[kept]
    canonical = canonical_frame(valid, instance)
    in_camera = transform_points(camera.camera_from_world, xyz.transpose(0, 1))[..., 2].T[valid]
    pixel_m = float(in_camera.median() / camera.intrinsics[0, 0, 0])
    part = split_rigid_parts(xyz, valid, confidence, instance, max_parts, pixel_m)
    level, points = initialise_objects(xyz, valid, confidence, part, canonical)
    return ObjectMotion(level, canonical, points, part, instance)


def _longest(valid: Bool[Tensor, "n t"], instance: Int[Tensor, " n"]) -> Int[Tensor, " m"]:
    """The tracks of each instance that are seen longest, without those that are hardly seen."""
    seen = valid.sum(1)
    enough = seen >= max(_MIN_SEEN, _MIN_SEEN_SHARE * valid.shape[1])
    best = [torch.zeros(0, dtype=torch.long)]
    for label in instance.unique():
        rows = (enough & (instance == label)).nonzero()[:, 0]
        best.append(rows[seen[rows].argsort(descending=True, stable=True)[:_MAX_TRACKS]].sort().values)
    return torch.cat(best)


def canonical_frame(valid: Bool[Tensor, "n t"], instance: Int[Tensor, " n"]) -> int:
    """The frame in which the instances are seen best, each by its own measure, so that none yields to a larger one.

    Ties go to the frame with more tracks, then to the one nearest the middle of the clip.
    """
    frames = valid.shape[1]
    share = torch.zeros(frames, dtype=torch.float64)
    for label in instance.unique():
        seen = valid[instance == label].sum(0).double()
        share += seen / seen.max().clamp(min=1)
    total = valid.sum(0).double()
    middle = (torch.arange(frames) - (frames - 1) / 2).abs()
    ranking = sorted(range(frames), key=lambda t: (-round(share[t].item(), 9), -total[t].item(), middle[t].item()))
    return ranking[0]


def initialise_objects(
    xyz: Float[Tensor, "n t 3"],
    valid: Bool[Tensor, "n t"],
    confidence: Float[Tensor, "n t"],
    part: Int[Tensor, " n"],
    canonical: int,
) -> tuple[MotionLevel, Float[Tensor, "n 3"]]:
    """One basis per part, the identity at the canonical frame, and every track's point (m) at that frame.

    Where too few tracks support a part, it goes with the part that it moved with before (a held block with the
    gripper), or stands still. A part that is never supported stands still altogether.
    """
    weights = torch.where(valid, confidence.square(), 0.0)
    rows = [(part == k).nonzero()[:, 0] for k in range(int(part.max()) + 1)] if len(part) else []
    fitted = [_fit_part(xyz[r], weights[r], None) for r in rows]
    if not fitted:
        return identity_level(torch.zeros(0, 3), xyz.shape[1]), torch.zeros(0, 3)
    motions, accepted = (torch.stack([getattr(f, name) for f in fitted]) for name in ("motions", "accepted"))
    carriers = find_carriers(motions, accepted, torch.stack([f.pivot for f in fitted]))
    points = torch.zeros(len(xyz), 3)
    # carriers are followed farther than what they carry, so they are completed first
    for k in sorted(range(len(rows)), key=lambda k: -int(accepted[k].sum())):
        carrier = int(carriers[k])
        carry = None if carrier == STILL else motions[carrier]
        fit = fitted[k] if carry is None else _fit_part(xyz[rows[k]], weights[rows[k]], carry)
        filled = fill_gaps(fit.motions, fit.accepted, fit.pivot, carry)
        motions[k] = filled @ invert_se3(filled[canonical])
        points[rows[k]] = _canonical_points(xyz[rows[k]], weights[rows[k]], motions[k], fit.accepted).float()
    pivots = torch.stack([points[r].mean(0) for r in rows])
    return level_from_motions(motions.float(), pivots), points


@dataclass(frozen=True)
class _PartFit:
    motions: Float[Tensor, "t 4 4"]  # from the part's own reference frame
    accepted: Bool[Tensor, " t"]
    pivot: Float[Tensor, "3"]  # m, at that frame


def _fit_part(
    xyz: Float[Tensor, "n t 3"], weights: Float[Tensor, "n t"], carry: Float[Tensor, "t 4 4"] | None
) -> _PartFit:
    fit = fit_rigid(xyz, weights[None], carry=None if carry is None else carry[None])
    points, known = model_points(xyz, weights, fit)
    seen = known[0] if known.any() else torch.ones_like(known[0])
    return _PartFit(fit.motions[0], fit.support[0] > 0, points[0, seen].mean(0))


def _canonical_points(
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "n t"],
    motions: Float[Tensor, "t 4 4"],
    accepted: Bool[Tensor, " t"],
) -> Float[Tensor, "n 3"]:
    """Tracks carried back, over the frames in which their part was followed; over all of them if that leaves none."""
    back = transform_points(invert_se3(motions), xyz.transpose(0, 1).double())
    followed = weights.double() * accepted
    used = torch.where(followed.sum(1, keepdim=True) > 0, followed, weights.double())
    return torch.einsum("nt,tnc->nc", used, back) / used.sum(1, keepdim=True).clamp(min=1e-12)
