"""The gate: scores of a new view at the checked frames, and whether it is kept, with the reason in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import GateConfig
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.reconstruction.account import decibels, pooled
from lerobot_msdyn.reconstruction.fast_camera import sharpness
from lerobot_msdyn.reconstruction.result import FittedWindow
from lerobot_msdyn.reconstruction.self_check import flicker, stands_still
from lerobot_msdyn.scene.rendering import Rendering, render_scene
from lerobot_msdyn.scene.sources import MovingPixels, moving_pixels_of_view
from lerobot_msdyn.views.coverage import Coverage, angles_of, coverage_of
from lerobot_msdyn.views.expected_error import Expected, expected_error

HEAT_WIDTH = 24  # columns of the map of what is uncovered
SHARPNESS_FLOOR = 0.25 / 255**2  # variance of the Laplacian (brightness 0..1) of a picture without any detail
FLICKER_FLOOR = 0.25 / 255  # difference of frames (0..1) that no 8-bit picture shows
MAX_RATIO = 100.0  # of a score to the video's own
SHOWS_NOTHING = 0.01  # of the sharpest judged frame's sharpness
CAUSES = {
    "video": "the scene does not match its own video (too few steps, wrong masks or motion)",
    "geometry": "the scene does not stand where the depth says (wrong masks, motion or depth)",
    "depth": "depth is known too roughly for so large a change of view",
    "sampling": "the pictures are too fine to be rendered from elsewhere",
}


@dataclass(frozen=True)
class FrameScores:
    """Scores of one frame of a new view."""

    frame: int  # of the episode
    expected_db: float  # expected peak signal-to-noise ratio
    unseen: float  # share of the pixels that is uncovered: no frame has shown it, 0..1
    angle_deg: float  # mean angle between the new line of sight and the recorded one, where it is covered
    sharpness_ratio: float  # to the recorded frame


@dataclass(frozen=True)
class Scores:
    """Scores of a new view of one episode, by one camera."""

    expected_db: float  # the episode's score: expected peak signal-to-noise ratio over all judged frames
    causes: dict[str, float]  # share of the expected error by cause, 0..1
    held_out_db: float  # of the recorded view, on frames that the fit never saw (if held_out), without overlay
    held_out_ssim: float
    moving_db: float  # the same over what moves: low where motion is not understood, however little of it there is
    moving_with_overlay_db: float  # the same with overlay, whose pixels are those of the recorded view itself
    by_motion: float  # share of this view's moving pixels that motion renders, 0..1; see scene/sources.py
    by_short_lived: float  # that short-lived Gaussians render ...
    by_overlay: float  # ... and an overlay; all 0 where nothing moves
    held_out: bool  # whether there were such frames
    unseen: float  # mean over the frames, 0..1
    angle_deg: float
    track_px: float  # tracks against the motion's projection
    flicker_ratio: float  # of what stands still, to the source's own
    sharpness_ratio: float
    frames: list[FrameScores]
    heat: list[list[int]]  # percent of the judged frames in which a part of the picture is uncovered
    skew_px: float = 0.0  # of 320: by how much a rolling shutter bends the video's fast frames
    fast_sharpness: float = 1.0  # of these, relative to the slow ones


@torch.no_grad()
def judge(windows: Sequence[FittedWindow], camera: CameraTrack) -> Scores:
    """Scores of an episode seen through another camera (any size, one pose per frame of the episode)."""
    frames: list[FrameScores] = []
    expected: list[Expected] = []
    uncovered, new_flicker, recorded_flicker = [], 0.0, 0.0
    sharp: list[tuple[float, float]] = []  # rendered and recorded, by frame
    moving = MovingPixels()
    for window in windows:
        check, recorded = window.self_check, to_device(window.evidence.camera, "cpu")
        fitted = check.camera
        poses = camera.select(check.frames + window.start).resized(fitted.width, fitted.height)
        error = expected_error(check, poses)
        rendering, coverages = _rendered(window, poses)
        moving += moving_pixels_of_view(window.scene, poses, check.frames, fitted, check.moving)
        pictures = rendering.rgb.clamp(0, 1)
        after = (check.frames + 1).clamp(max=window.scene.frames - 1)
        following = to_device(render_scene(window.scene, poses, after), "cpu")
        still = stands_still(rendering.moving > 0.05) & stands_still(following.moving > 0.05)
        new_flicker += len(poses) * flicker(pictures, following.rgb.clamp(0, 1), still)
        recorded_flicker += len(poses) * check.flicker
        expected.append(error)
        uncovered += [coverage.unseen for coverage in coverages]
        for i, (frame, coverage) in enumerate(zip(check.frames.tolist(), coverages, strict=True)):
            sharp.append((sharpness(pictures[i : i + 1]), sharpness(check.recorded[i : i + 1])))
            covered = ~coverage.unseen
            angles = angles_of(rendering.depth[i], poses.select([i]), recorded.select([frame]))
            angle = float(angles[covered].mean()) if covered.any() else 180.0
            frames.append(
                FrameScores(
                    frame + window.start,
                    decibels(float(error.total[i])),
                    coverage.unseen_share,
                    angle,
                    ratio(*sharp[-1]),
                )
            )
    total = Expected(**{name: torch.cat([getattr(part, name) for part in expected]) for name in vars(expected[0])})
    checks = [window.self_check for window in windows]
    account = pooled([check.account for check in checks])
    return Scores(
        total.psnr_db,
        total.shares,
        decibels(float(torch.cat([check.fitted_error for check in checks]).mean())),
        float(np.mean([check.ssim for check in checks])),
        decibels(account.error_by_motion),
        decibels(account.error),
        moving.shares["by_motion"],
        moving.shares["by_short_lived"],
        moving.shares["by_overlay"],
        all(check.held_out for check in checks),
        float(np.mean([frame.unseen for frame in frames])),
        float(np.mean([frame.angle_deg for frame in frames])),
        float(np.mean([check.track_px for check in checks])),
        ratio(new_flicker, recorded_flicker, FLICKER_FLOOR * len(frames)),
        sharpness_ratio(sharp),
        frames,
        _heat(np.mean(uncovered, axis=0)),
        max(check.skew_px for check in checks),
        min(check.fast_sharpness for check in checks),
    )


def ratio(new: float, recorded: float, floor: float = SHARPNESS_FLOOR) -> float:
    """A measure of the new view relative to the video's; what is under `floor` in both is alike, nothing explodes."""
    return min(max(new, floor) / max(recorded, floor), MAX_RATIO)


def sharpness_ratio(sharp: Sequence[tuple[float, float]]) -> float:
    """Mean over frames, without those whose recorded picture is far less sharp than the sharpest: they show nothing."""
    sharpest = max(recorded for _, recorded in sharp)
    return float(np.mean([ratio(*pair) for pair in sharp if pair[1] >= SHOWS_NOTHING * sharpest]))


def reasons(scores: Scores, config: GateConfig) -> list[str]:
    """Why a view is not kept, in words; empty if it is."""
    worst = max(scores.causes, key=lambda name: scores.causes[name])
    why = []
    if scores.expected_db < config.min_expected_db:
        why.append(
            f"expected quality {scores.expected_db:.1f} dB is under gate.min_expected_db {config.min_expected_db:g}: "
            f"{CAUSES[worst]}"
        )
    for value, limit, name, text in (
        (scores.track_px, config.max_track_px, "max_track_px", "px from the tracks to the motion"),
        (scores.flicker_ratio, config.max_flicker_ratio, "max_flicker_ratio", "times the video's own flicker"),
    ):
        if value > limit:
            why.append(f"{value:.1f} {text}, over gate.{name} {limit:g}")
    if scores.sharpness_ratio < config.min_sharpness_ratio:
        why.append(
            f"{scores.sharpness_ratio:.2f} of the video's sharpness, under gate.min_sharpness_ratio "
            f"{config.min_sharpness_ratio:g}"
        )
    return why


def video_reasons(windows: Sequence[FittedWindow], config: GateConfig) -> list[str]:
    """Why no view of a video is kept, in words: its camera goes too fast for it; empty if some may be."""
    why = []
    skew_px = max(window.self_check.skew_px for window in windows)
    sharp = min(window.self_check.fast_sharpness for window in windows)
    if skew_px > config.max_skew_px:
        why.append(
            f"the camera goes so fast that a rolling shutter bends pictures by {skew_px:.1f} px (of 320), over "
            f"gate.max_skew_px {config.max_skew_px:g}; raise it if the shutter is global"
        )
    if sharp < config.min_fast_sharpness:
        why.append(
            f"the camera blurs pictures as it goes fast: {sharp:.2f} of the sharpness of slow ones, under "
            f"gate.min_fast_sharpness {config.min_fast_sharpness:g}"
        )
    return why


def record(scores: Scores) -> dict[str, Any]:
    """Scores as plain values for a JSON file, rounded."""
    return {name: _plain(value) for name, value in vars(scores).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 4)
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return {name: _plain(item) for name, item in vars(value).items()} if isinstance(value, FrameScores) else value


def _rendered(window: FittedWindow, poses: CameraTrack) -> tuple[Rendering, list[Coverage]]:
    """The checked frames through other poses, and what is known about their pixels; on the host."""
    rendering = render_scene(window.scene, poses, window.self_check.frames, extra=window.evidence.moving_frames)
    return to_device(rendering, "cpu"), coverage_of(rendering, poses, window.evidence)


def _heat(uncovered: Float[ndarray, "h w"]) -> list[list[int]]:
    """A small map of shares, in percent."""
    height, width = uncovered.shape
    size = (HEAT_WIDTH, max(1, round(HEAT_WIDTH * height / width)))
    small = cv2.resize(uncovered.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return [[round(100 * float(value)) for value in row] for row in small]
