"""Rigid parts registered to the recorded depth, pictures and masks, where tracks alone let plain surfaces slide."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.geometry import invert_se3, quaternion_to_matrix, se3, transform_points
from lerobot_msdyn.core.sampling import evenly, scaled_px
from lerobot_msdyn.motion.model.bases import MotionLevel, level_affines, level_from_motions
from lerobot_msdyn.motion.model.scene_motion import SceneMotion
from lerobot_msdyn.motion.spec import frames_per_knot
from lerobot_msdyn.motion.to_video.alignment import Sightings, Video, centres, costs_in_camera, read_video, sight
from lerobot_msdyn.motion.to_video.regroup import Grouping, regroup

_MODEL_FRAMES = 14  # evenly spread, from which points are gathered; those half-way between them judge
_POINTS = 400  # of a frame
_JUDGES = 150  # of a frame
_JUDGED_FRAMES = 24
_WORTH = 0.01  # of the judges' cost, that a finer level must take away


@dataclass(frozen=True)
class Recording:
    """What was recorded of a scene, as evidence of how it moves."""

    video: Video
    points: Sightings  # that are aligned
    judges: Sightings  # of other frames

    @classmethod
    def of(
        cls,
        rgb: UInt8[Tensor, "t h w 3"],
        depth: Float[Tensor, "t h w"],
        instances: UInt8[Tensor, "t h w"],
        camera: CameraTrack,
    ) -> "Recording | None":
        """That of a video with z-depth (m, 0 = unknown) and instances (0 = what stands still); None if none moves."""
        seen = depth[(instances > 0) & (depth > 0)]
        if len(seen) == 0:
            return None
        pixel_m = scaled_px(float(seen.median() / camera.intrinsics[0, 0, 0]), camera.width)
        video = read_video(rgb, depth, instances, camera, pixel_m)
        spread = evenly(len(rgb), 2 * _MODEL_FRAMES - 1).tolist()
        return cls(video, sight(video, spread[::2], _POINTS), sight(video, spread[1::2], _JUDGES))

    def register(self, motion: SceneMotion, config: MotionConfig, known: int = 0) -> SceneMotion:
        """An object level with better parts and poses, followed by the points of this recording.

        Unless points that were gathered at other frames agree better with the whole clip by the new motion, it stays
        as it is. The parts of the instance `known` (0: none) and their motions stay.
        """
        if len(self.points) == 0:
            return motion
        grouping = regroup(self.video, self.points, self._start(motion), config.max_parts, known)
        new = _with_parts(motion, grouping, self.points, frames_per_knot(motion.names[0], config))
        return new if self.costs(new)[0].mean() < self.costs(motion)[0].mean() else motion

    def approval(self, motion: SceneMotion, name: str) -> Callable[[MotionLevel], Bool[Tensor, " k"]]:
        """Says in which parts another level, of this name, makes the judges agree better with the clip."""

        def approve(level: MotionLevel) -> Bool[Tensor, " k"]:
            finer = replace(motion, names=(*motion.names, name), levels=(*motion.levels, level))
            before, part = self.costs(motion)
            total, gain = torch.zeros(2, len(cast(MotionLevel, motion.levels[0])))
            total.index_add_(0, part, before)
            gain.index_add_(0, part, before - self.costs(finer)[0])
            return gain > _WORTH * total

        return approve

    def guided(self, motion: SceneMotion) -> SceneMotion:
        """The motion, followed by the points of this recording where all of its levels put them."""
        return replace(motion, points=_traced(motion, self.points)[0])

    def costs(self, motion: SceneMotion) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
        """How badly each judge fits the clip when a motion carries it (0 to 1), and the part that it follows."""
        frames = evenly(len(self.video), _JUDGED_FRAMES)
        view = self.video.camera.camera_from_world[frames]
        points, part = _traced(motion, self.judges)
        moved, turns = motion.moved(points, part, torch.cat((frames, self.judges.frame.unique())))
        rotations = quaternion_to_matrix(turns)
        seen_at = len(frames) + torch.unique(self.judges.frame, return_inverse=True)[1]
        back = rotations[seen_at, torch.arange(len(part))].transpose(1, 2)
        normals = rotations[: len(frames)] @ (back @ self.judges.normals[..., None])
        in_camera = normals[..., 0] @ view[:, :3, :3].transpose(1, 2)
        placed = transform_points(view, moved[: len(frames)])
        return costs_in_camera(self.video, placed, in_camera, self.judges.grey, frames), part

    def _start(self, motion: SceneMotion) -> Grouping:
        level = cast(MotionLevel, motion.levels[0])
        affines = level_affines(level, torch.arange(len(self.video)))
        motions = se3(affines[..., :3], affines[..., 3]).double()
        instance = torch.zeros(len(level), dtype=torch.long)
        instance[motion.part] = motion.instance
        return Grouping(_traced(motion, self.points)[1], motions, motions, instance, level.active)


def _traced(motion: SceneMotion, seen: Sightings) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """Canonical points (m), and parts, of what frames show."""
    points, part = torch.zeros_like(seen.xyz), torch.zeros_like(seen.frame)
    for t in seen.frame.unique().tolist():
        rows = seen.frame == t
        points[rows], part[rows] = motion.to_canonical(seen.xyz[rows], t, seen.instance[rows])
    return points, part


def _with_parts(motion: SceneMotion, grouping: Grouping, seen: Sightings, knot_step: int) -> SceneMotion:
    """The motion by other parts, which are the identity at the canonical frame."""
    at_canonical = grouping.motions[:, motion.canonical_frame]
    motions = grouping.motions @ invert_se3(at_canonical)[:, None]
    points = seen.at_canonical(motions, grouping.part)[0].float()
    pivots = centres(points, grouping.part, len(motions))[0]
    level = level_from_motions(
        motions.float(), pivots, active=grouping.active, frames_per_knot=knot_step, canonical=motion.canonical_frame
    )
    return replace(motion, levels=(level,), points=points, part=grouping.part, instance=seen.instance)
