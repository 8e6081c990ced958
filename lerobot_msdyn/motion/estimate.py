"""From tracks to the motion of a scene: lift, canonical frame, rigid parts, then one level after the other."""

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.geometry import transform_points
from lerobot_msdyn.core.observations import BodyTracks, PointTracks
from lerobot_msdyn.core.sampling import scaled_px
from lerobot_msdyn.motion.finer.add_level import Approve, add_level
from lerobot_msdyn.motion.finer.residual import ResidualTracks, pull_back
from lerobot_msdyn.motion.from_tracks.lift import LiftedTracks, lift_tracks, position_noise
from lerobot_msdyn.motion.from_tracks.objects import canonical_frame, initialise_objects
from lerobot_msdyn.motion.from_tracks.outliers import coherence
from lerobot_msdyn.motion.from_tracks.parts import split_rigid_parts
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.compose import Level
from lerobot_msdyn.motion.model.scene_motion import SceneMotion
from lerobot_msdyn.motion.spec import FirstLevel, PartTracks, finer_level, first_level, frames_per_knot
from lerobot_msdyn.motion.to_video.register import Recording

_MIN_SEEN = 3  # frames, and 5 % of the clip, in which a track must be seen
_MIN_SEEN_SHARE = 0.05
_MAX_TRACKS = 2500  # of an instance that are used, the longest ones
_STILL_PX = 0.3  # an object that moves by less does not move
_CANONICAL_FRAMES = 2.0  # about the canonical one, over which a point is averaged: the less, the farther away
_MEAN_ROUNDS = 3  # of robust weights
_OUTLIER = 3.0  # times the usual distance from the mean: half of the weight and more is lost

_VOTING_FRAMES = 3  # in which a track was seen, that decide its part


def scene_motion(
    tracks: PointTracks,
    depth: Float[Tensor, "t h w"],
    camera: CameraTrack,
    config: MotionConfig,
    recording: Recording | None = None,
    bodies: BodyTracks | None = None,
) -> SceneMotion | None:
    """Motion of everything that was tracked or is known, or None where nothing is.

    Args:
        tracks: points followed in the image.
        depth: z-depth in m, 0 = unknown.
        camera: the camera that saw both.
        config: the levels.
        recording: what the video shows, by which the object level is improved and finer ones are judged.
        bodies: those whose motion is known; it is their object level.
    """
    xyz, valid = lift_tracks(tracks, depth, camera)
    kept = _longest(valid, tracks.instance)
    lifted = LiftedTracks(xyz[kept], valid[kept], tracks.confidence[kept], tracks.instance[kept], 0.0)
    if bodies is not None:
        lifted = lifted.followed_by(bodies)
    if not bool(lifted.valid.any()):
        return None
    in_camera = transform_points(camera.camera_from_world, lifted.xyz.transpose(0, 1))[..., 2].T[lifted.valid]
    pixel_m = scaled_px(float(in_camera.median() / camera.intrinsics[0, 0, 0]), camera.width)
    return motion_from_tracks(replace(lifted, pixel_m=pixel_m), config, recording)


def motion_from_tracks(tracks: LiftedTracks, config: MotionConfig, recording: Recording | None = None) -> SceneMotion:
    """All levels of motion (the paper's section on initialisation; docs/motion.md), from at least one track.

    Raises:
        ConfigError: the levels cannot stand in this order, or a setting is not allowed.
    """
    wrong = problems(config, "motion.")
    if wrong:
        raise ConfigError("; ".join(wrong))
    first = first_level(config.levels[0])
    parts = rigid_parts(tracks, config)
    registered = parts
    if recording is not None and first.by_video and bool(_bases(parts).active.any()):
        registered = recording.register(parts, config, _known_instance(tracks))
    if registered is parts:
        recording = None  # finer levels are judged by tracks alone
    given = PartTracks(
        _bases(registered),
        parts.points,
        parts.part if recording is None else _parts_of(registered, tracks),
        tracks.xyz,
        torch.where(tracks.valid, tracks.confidence.square(), 0.0),
        parts.canonical_frame,
        position_noise(tracks.xyz, tracks.valid),
    )
    levels = (first.estimate(given, config),)
    motion = SceneMotion((config.levels[0],), levels, parts.canonical_frame, parts.points, given.part, tracks.instance)

    def by_video(so_far: SceneMotion, name: str) -> Approve | None:
        if recording is None:
            return None
        return recording.approval(replace(registered, names=so_far.names, levels=so_far.levels), name)

    if len(config.levels) > 1:
        left = _left_by(first, levels[0], given, tracks.valid)
        motion = _with_finer_levels(motion, left, tracks, config, given.noise, by_video)
    soft = replace(motion, blend_parts=config.blend_parts, blend_reach=config.blend_reach)
    if recording is None:
        return soft
    return recording.guided(replace(soft, points=registered.points, part=registered.part, instance=registered.instance))


def _with_finer_levels(
    motion: SceneMotion,
    left: ResidualTracks,
    tracks: LiftedTracks,
    config: MotionConfig,
    noise: float,
    by_video: Callable[[SceneMotion, str], Approve | None],
) -> SceneMotion:
    """The motion with the levels that the config names; `left` are the tracks as the first one leaves them.

    A level that is refused in all parts is left out, and with it those that would refine it.
    """
    refused = False
    for name in config.levels[1:]:
        if refused and finer_level(name).refines:
            continue
        so_far = replace(motion, points=left.points)
        level, left_by_it = add_level(name, left, tracks, so_far, config, noise, by_video(motion, name))
        refused = not bool(level.active.any())
        if refused:
            continue
        left = left_by_it
        motion = SceneMotion(
            (*motion.names, name),
            (*motion.levels, level),
            motion.canonical_frame,
            _usual_positions(left.positions, left.weights, noise),
            motion.part,
            motion.instance,
        )
    return motion


def rigid_parts(tracks: LiftedTracks, config: MotionConfig) -> SceneMotion:
    """The rigid parts of all instances, and their motions, by tracks alone: an object level."""
    canonical = canonical_frame(tracks.valid, tracks.instance)
    known = torch.zeros_like(tracks.instance, dtype=torch.bool) if tracks.body is None else tracks.body >= 0
    rows = (~known).nonzero()[:, 0]
    part = torch.full_like(tracks.instance, -1)
    part[rows] = split_rigid_parts(
        tracks.xyz[rows],
        tracks.valid[rows],
        tracks.confidence[rows],
        tracks.instance[rows],
        config.max_parts,
        tracks.pixel_m,
    )
    if tracks.body is not None:
        part[known] = tracks.body[known] + int(part.max()) + 1
    objects, points = initialise_objects(
        tracks.xyz,
        tracks.valid | known[:, None],
        torch.where(known[:, None], 1.0, tracks.confidence),
        part,
        canonical,
        still_m=_STILL_PX * tracks.pixel_m,
        frames_per_knot=frames_per_knot("object", config),
    )
    return SceneMotion(("object",), (objects,), canonical, points, part, tracks.instance)


def _known_instance(tracks: LiftedTracks) -> int:
    """The instance whose bodies are known; 0: there is none."""
    known = tracks.instance[:0] if tracks.body is None else tracks.instance[tracks.body >= 0]
    return int(known[0]) if len(known) else 0


def _bases(parts: SceneMotion) -> MotionLevel:
    return cast(MotionLevel, parts.levels[0])


def _left_by(first: FirstLevel, level: Level, given: PartTracks, valid: Bool[Tensor, "n t"]) -> ResidualTracks:
    """The tracks as the first level leaves them; those that do not keep with their part count less."""
    if not isinstance(level, MotionLevel):
        raise ConfigError(f"a motion level of kind {level.kind!r} has no bases that a finer level could refine")
    indices, logits = first.bind(level, given.points, given.part, None)
    positions = pull_back(level, indices, logits, given.xyz)
    start = near_canonical(positions, given.weights, given.canonical)
    weights = given.weights * coherence(start, positions, valid, given.part, given.noise)
    owner = indices.gather(1, logits.argmax(1, keepdim=True))[:, 0]
    return ResidualTracks(near_canonical(positions, weights, given.canonical), positions, weights, given.part, owner)


def _parts_of(motion: SceneMotion, tracks: LiftedTracks) -> Int[Tensor, " n"]:
    """Part of every track, by what is near it where it is seen; no part is left without tracks."""
    count = len(_bases(motion))
    votes = torch.zeros(len(tracks.xyz), count)
    at_canonical = torch.zeros(len(tracks.xyz), 3)
    seen = tracks.valid.cumsum(1)
    for quantile in torch.linspace(0, 1, _VOTING_FRAMES + 2)[1:-1].tolist():
        at = (seen >= (quantile * seen[:, -1:]).clamp(min=1)).int().argmax(1)
        for frame in at.unique().tolist():
            rows = (at == frame).nonzero()[:, 0]
            at_canonical[rows], voted = motion.to_canonical(tracks.xyz[rows, frame], frame, tracks.instance[rows])
            votes[rows, voted] += 1
    part = votes.argmax(1)
    for k in range(count):
        members = motion.points[motion.part == k]
        if len(members) and not bool((part == k).any()):
            part[(at_canonical - members.mean(0)).norm(dim=-1).argmin()] = k
    return part


def _usual_positions(
    positions: Float[Tensor, "n t 3"], weights: Float[Tensor, "n t"], noise: float
) -> Float[Tensor, "n 3"]:
    """Robust mean over time of each track (Geman-McClure weights), once all levels have been taken out of it."""
    trusted = weights.to(positions)
    for _ in range(_MEAN_ROUNDS):
        total = trusted.sum(1, keepdim=True).clamp(min=1e-12)
        mean = torch.einsum("nt,ntc->nc", trusted, positions) / total
        distance = (positions - mean[:, None]).norm(dim=-1)
        usual = torch.where(weights > 0, distance, torch.nan).nanmedian(1, keepdim=True).values
        scale = _OUTLIER * usual.clamp(min=max(noise, 1e-9))
        trusted = weights / (1 + (distance / scale).square()).square()
    return mean


def near_canonical(
    positions: Float[Tensor, "n t 3"], weights: Float[Tensor, "n t"], canonical: int
) -> Float[Tensor, "n 3"]:
    """Mean position about the canonical frame, or about the nearest frame in which a track was seen."""
    apart = (torch.arange(positions.shape[1]) - canonical).abs().expand(weights.shape)
    nearest = torch.where(weights > 0, apart, 10**9).amin(1, keepdim=True)
    nearness = weights * torch.exp(-(apart - nearest).clamp(min=0) / _CANONICAL_FRAMES)
    return torch.einsum("nt,ntc->nc", nearness, positions) / nearness.sum(1, keepdim=True).clamp(min=1e-12)


def _longest(valid: Bool[Tensor, "n t"], instance: Int[Tensor, " n"]) -> Int[Tensor, " m"]:
    """The tracks of each instance that are seen longest, without those that are hardly seen."""
    seen = valid.sum(1)
    enough = seen >= max(_MIN_SEEN, _MIN_SEEN_SHARE * valid.shape[1])
    best = [torch.zeros(0, dtype=torch.long)]
    for label in instance.unique():
        rows = (enough & (instance == label)).nonzero()[:, 0]
        best.append(rows[seen[rows].argsort(descending=True, stable=True)[:_MAX_TRACKS]].sort().values)
    return torch.cat(best)
