"""Rigid parts registered to the recorded depth, pictures and masks, where tracks alone let plain surfaces slide."""

from dataclasses import replace
from typing import cast

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.geometry import invert_se3, matrix_to_rotation_6d, se3, transform_points
from lerobot_msdyn.motion.alignment import Frame, Model, align, compare, read_frame
from lerobot_msdyn.motion.bases import MotionLevel, level_affines
from lerobot_msdyn.motion.follow import SceneMotion

_MODEL_FRAMES = 14  # evenly spread, from which the model is gathered; those half-way between them judge
_POINTS = 100  # of a part from a frame
_PIXELS = 3000  # of a frame, among which they are sought
_BORDER_PX = 2  # of the masks, without points
_ROUNDS = 3  # of gathering a model and aligning it
_JUDGED_FRAMES = 24
_OUTLIER = 3.0  # sigmas beyond which a judge's error hardly grows


def register_parts(
    motion: SceneMotion,
    rgb: UInt8[Tensor, "t h w 3"],
    depth: Float[Tensor, "t h w"],
    instances: UInt8[Tensor, "t h w"],
    camera: CameraTrack,
) -> SceneMotion:
    """The motion with better poses of its rigid parts (docs/method.md, "Registration").

    A model is gathered from some frames by the motion so far and aligned to every frame, in turn. A part keeps the
    pose from tracks unless points that were gathered at other frames agree better with the video by the new one.

    Args:
        motion: an object level alone.
        rgb: the video.
        depth: z-depth in m, 0 = unknown.
        instances: 0 = what stands still.
        camera: the camera that saw them.
    """
    frames, seen = len(rgb), depth[(instances > 0) & (depth > 0)]
    if len(seen) == 0:
        return motion
    pixel_m = float(seen.median() / camera.intrinsics[0, 0, 0])
    shown = [read_frame(rgb[t], depth[t], instances[t], camera.select([t]), pixel_m) for t in range(frames)]
    spread = torch.linspace(0, frames - 1, 2 * _MODEL_FRAMES - 1).round().long().unique().tolist()
    tracked, found = _motions(_object_level(motion), frames), motion
    for _ in range(_ROUNDS):
        found, tracked = _round(found, tracked, shown, spread[::2])
    better = _errors(found, shown, spread[1::2]) < _errors(motion, shown, spread[1::2])
    return _chosen(better, found, motion)


def _round(
    motion: SceneMotion, tracked: Float[Tensor, "k t 4 4"], shown: list[Frame], frames: list[int]
) -> tuple[SceneMotion, Float[Tensor, "k t 4 4"]]:
    """Gather and align once; the canonical points go where the alignment puts them at the canonical frame.

    `tracked` are the motions from tracks, here and in what is returned of the canonical points of the motion beside it.
    """
    level = _object_level(motion)
    model = _gather(motion, shown, frames)
    if len(model.part) == 0:
        return motion, tracked
    before, reach = _motions(level, len(shown)), _reach(model, level.pivots)
    aligned = [align(model, before[:, t], tracked[:, t], level.pivots, reach, shown[t]) for t in range(len(shown))]
    after = torch.where(level.active[:, None, None, None], torch.stack(aligned, dim=1), before)
    gauge = after[:, motion.canonical_frame]
    back = invert_se3(gauge)[:, None]
    pivots = transform_points(gauge, level.pivots[:, None])[:, 0]
    points = transform_points(gauge[motion.part], motion.points[:, None])[:, 0]
    return replace(motion, levels=(_with_motions(level, after @ back, pivots),), points=points), tracked @ back


def _object_level(motion: SceneMotion) -> MotionLevel:
    return cast(MotionLevel, motion.levels[0])


def _motions(level: MotionLevel, frames: int) -> Float[Tensor, "k t 4 4"]:
    """The motions of a level at all frames."""
    affines = level_affines(level, torch.arange(frames))
    return se3(affines[..., :3], affines[..., 3])


def _with_motions(level: MotionLevel, motions: Float[Tensor, "k t 4 4"], pivots: Float[Tensor, "k 3"]) -> MotionLevel:
    """A level with other motions, about other pivots (m)."""
    chosen = motions[:, level.knots.long()]
    moved = (chosen[..., :3, :3] @ pivots[:, None, :, None])[..., 0] + chosen[..., :3, 3]
    return replace(
        level,
        rotations_6d=matrix_to_rotation_6d(chosen[..., :3, :3]),
        displacements=moved - pivots[:, None],
        pivots=pivots,
    )


def _gather(motion: SceneMotion, shown: list[Frame], frames: list[int]) -> Model:
    """Points of all parts, from some frames, at the canonical frame."""
    window = np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)
    gathered = [(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, dtype=torch.long))]
    for t in frames:
        frame = shown[t]
        inner = cv2.erode((frame.instances > 0).numpy().astype(np.uint8), window) > 0
        row, column = _thinned((torch.from_numpy(inner) & frame.known).nonzero(), _PIXELS).unbind(-1)
        if len(row) == 0:
            continue
        points, part = motion.to_canonical(frame.xyz(row, column), t, frame.instances[row, column].long())
        kept = torch.cat([_thinned((part == k).nonzero()[:, 0], _POINTS) for k in part.unique()])
        turns = level_affines(_object_level(motion), torch.tensor([t]))[part, 0, :, :3]
        normals = (turns.transpose(1, 2) @ frame.normals(row, column)[..., None])[..., 0]
        gathered.append((points[kept], normals[kept], frame.grey[row, column][kept], part[kept]))
    return Model(*(torch.cat(each) for each in zip(*gathered, strict=True)))


def _thinned(rows: Int[Tensor, "n *_"], most: int) -> Int[Tensor, "m *_"]:
    """Evenly spread rows, `most` at most."""
    return rows[torch.linspace(0, len(rows) - 1, min(len(rows), most)).round().long()]


def _reach(model: Model, pivots: Float[Tensor, "k 3"]) -> Float[Tensor, " k"]:
    """Root mean square distance (m) of each part's points from its pivot; of parts without points, 1 m."""
    square, count = torch.zeros(2, len(pivots))
    square.index_add_(0, model.part, (model.points - pivots[model.part]).square().sum(-1))
    count.index_add_(0, model.part, torch.ones(len(model.part)))
    return torch.where(count > 0, (square / count.clamp(min=1)).sqrt().clamp(min=1e-3), 1.0)


def _errors(motion: SceneMotion, shown: list[Frame], frames: list[int]) -> Float[Tensor, " k"]:
    """Robust mean error of each part, of points gathered from some frames and compared with the whole clip."""
    level = _object_level(motion)
    model, motions = _gather(motion, shown, frames), _motions(level, len(shown))
    error, count = torch.zeros(2, len(level))
    for t in torch.linspace(0, len(shown) - 1, _JUDGED_FRAMES).round().long().unique().tolist():
        terms = compare(model, motions[:, t], shown[t])
        square = (terms.residuals / _OUTLIER).square()
        cost = square / (1 + square)
        cost[2] = 1  # shown where nothing moves
        used = terms.weights > 0
        error.index_add_(0, model.part, (used * cost).sum(0))
        count.index_add_(0, model.part, (used[0] | used[2]).float())
    return error / count.clamp(min=1)


def _chosen(better: Bool[Tensor, " k"], new: SceneMotion, old: SceneMotion) -> SceneMotion:
    """The new motion of some parts, the old one of the others."""
    level, before = _object_level(new), _object_level(old)
    rows = better[:, None, None]
    mixed = replace(
        before,
        rotations_6d=torch.where(rows, level.rotations_6d, before.rotations_6d),
        displacements=torch.where(rows, level.displacements, before.displacements),
        pivots=torch.where(better[:, None], level.pivots, before.pivots),
    )
    return replace(old, levels=(mixed,), points=torch.where(better[old.part][:, None], new.points, old.points))
