"""From tracks to the motion of a scene: lift, canonical frame, rigid parts, then one level after the other."""

from dataclasses import replace
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import LevelName, MotionConfig
from lerobot_msdyn.core.geometry import transform_points
from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.motion.field import fit_field
from lerobot_msdyn.motion.finer.add_level import add_level
from lerobot_msdyn.motion.finer.residual import ResidualTracks, pull_back
from lerobot_msdyn.motion.flat import fit_flat
from lerobot_msdyn.motion.from_tracks.lift import LiftedTracks, lift_tracks, position_noise
from lerobot_msdyn.motion.from_tracks.objects import canonical_frame, initialise_objects
from lerobot_msdyn.motion.from_tracks.outliers import coherence
from lerobot_msdyn.motion.from_tracks.parts import split_rigid_parts
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.compose import Level
from lerobot_msdyn.motion.model.scene_motion import SceneMotion
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
) -> SceneMotion | None:
    """Motion of everything that was tracked, or None where nothing was.

    Args:
        tracks: points followed in the image.
        depth: z-depth in m, 0 = unknown.
        camera: the camera that saw both.
        config: the levels.
        recording: what the video shows, by which the object level is improved and finer ones are judged.
    """
    xyz, valid = lift_tracks(tracks, depth, camera)
    kept = _longest(valid, tracks.instance)
    if len(kept) == 0:
        return None
    xyz, valid = xyz[kept], valid[kept]
    in_camera = transform_points(camera.camera_from_world, xyz.transpose(0, 1))[..., 2].T[valid]
    pixel_m = float(in_camera.median() / camera.intrinsics[0, 0, 0])
    lifted = LiftedTracks(xyz, valid, tracks.confidence[kept], tracks.instance[kept], pixel_m)
    return motion_from_tracks(lifted, config, recording)


def motion_from_tracks(tracks: LiftedTracks, config: MotionConfig, recording: Recording | None = None) -> SceneMotion:
    """All levels of motion (the paper's section on initialisation; docs/method.md), from at least one track."""
    noise = position_noise(tracks.xyz, tracks.valid)
    canonical = canonical_frame(tracks.valid, tracks.instance)
    part = split_rigid_parts(
        tracks.xyz, tracks.valid, tracks.confidence, tracks.instance, config.max_parts, tracks.pixel_m
    )
    objects, points = initialise_objects(
        tracks.xyz,
        tracks.valid,
        tracks.confidence,
        part,
        canonical,
        still_m=_STILL_PX * tracks.pixel_m,
        frames_per_knot=config.frames_per_knot.object,
    )
    by_tracks = registered = SceneMotion(("object",), (objects,), canonical, points, part, tracks.instance)
    if recording is not None and config.levels[0] == "object" and bool(objects.active.any()):
        registered = recording.register(by_tracks, config)
    if registered is not by_tracks:
        objects = cast(MotionLevel, registered.levels[0])
        part = _parts_of(registered, tracks)
    weights = torch.where(tracks.valid, tracks.confidence.square(), 0.0)
    names, levels = _first_level(config, objects, points, tracks.xyz, weights, canonical, noise)
    positions = pull_back(objects, part[:, None], torch.zeros(len(part), 1), tracks.xyz)
    start = near_canonical(positions, weights, canonical)
    weights = weights * coherence(start, positions, tracks.valid, part, noise)
    left = ResidualTracks(near_canonical(positions, weights, canonical), positions, weights, part, part)
    for name in config.levels[1:]:
        so_far = SceneMotion(names, levels, canonical, left.points, part, tracks.instance)
        approve = None
        if recording is not None and registered is not by_tracks:
            approve = recording.approval(replace(registered, names=names, levels=levels), name)
        level, left = add_level(name, left, tracks, so_far, config, noise, approve)
        names, levels = (*names, name), (*levels, level)
        points = _usual_positions(left.positions, weights, noise)
    if recording is not None and registered is not by_tracks:
        return recording.guided(replace(registered, names=names, levels=levels))
    return SceneMotion(names, levels, canonical, points, part, tracks.instance)


def _parts_of(motion: SceneMotion, tracks: LiftedTracks) -> Int[Tensor, " n"]:
    """Part of every track, by what is near it where it is seen; no part is left without tracks."""
    count = len(cast(MotionLevel, motion.levels[0]))
    votes = torch.zeros(len(tracks.xyz), count)
    at_canonical = torch.zeros(len(tracks.xyz), 3)
    seen = tracks.valid.cumsum(1)
    for share in torch.linspace(0, 1, _VOTING_FRAMES + 2)[1:-1].tolist():
        at = (seen >= (share * seen[:, -1:]).clamp(min=1)).int().argmax(1)
        for frame in at.unique().tolist():
            rows = (at == frame).nonzero()[:, 0]
            at_canonical[rows], found = motion.to_canonical(tracks.xyz[rows, frame], frame, tracks.instance[rows])
            votes[rows, found] += 1
    part = votes.argmax(1)
    for k in range(count):
        own = motion.points[motion.part == k]
        if len(own) and not bool((part == k).any()):
            part[(at_canonical - own.mean(0)).norm(dim=-1).argmin()] = k
    return part


def _first_level(
    config: MotionConfig,
    objects: MotionLevel,
    points: Float[Tensor, "n 3"],
    xyz: Float[Tensor, "n t 3"],
    weights: Float[Tensor, "n t"],
    canonical: int,
    noise: float,
) -> tuple[tuple[LevelName, ...], tuple[Level, ...]]:
    """The coarsest level: objects, or one of the two models of other systems, given the same canonical points."""
    if config.levels[0] == "flat":
        return ("flat",), (fit_flat(points, xyz, weights, config.flat_bases, canonical, noise),)
    if config.levels[0] == "field":
        return ("field",), (fit_field(points, xyz, weights),)
    return ("object",), (objects,)


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
    share = weights * torch.exp(-(apart - nearest).clamp(min=0) / _CANONICAL_FRAMES)
    return torch.einsum("nt,ntc->nc", share, positions) / share.sum(1, keepdim=True).clamp(min=1e-12)


def _longest(valid: Bool[Tensor, "n t"], instance: Int[Tensor, " n"]) -> Int[Tensor, " m"]:
    """The tracks of each instance that are seen longest, without those that are hardly seen."""
    seen = valid.sum(1)
    enough = seen >= max(_MIN_SEEN, _MIN_SEEN_SHARE * valid.shape[1])
    best = [torch.zeros(0, dtype=torch.long)]
    for label in instance.unique():
        rows = (enough & (instance == label)).nonzero()[:, 0]
        best.append(rows[seen[rows].argsort(descending=True, stable=True)[:_MAX_TRACKS]].sort().values)
    return torch.cat(best)
