"""Where the scene carries what it shows at a tracked pixel, against where the track is (the paper's L_track).

The form is that of Shape of Motion (Wang et al. 2024, section 3.4): positions at other times are rendered at the frame.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.geometry import nearest_pixel, project, transform_points
from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.loss_terms import FitStep
from lerobot_msdyn.scene.rendering import render_positions

TIMES = 2  # frames to which points are carried
DEPTH_WEIGHT = 0.1  # of the difference of inverse depths, in units of that of the look-at point
KEPT = 0.98  # share of the errors that count, the smallest
LEAST_ALPHA = 0.5  # of a pixel whose surface has a place


@LOSSES.register("track")
def track(step: FitStep) -> Float[Tensor, ""]:
    """Mean over the step's frames, each carried to `TIMES` others that are drawn."""
    losses = []
    for frame in step.frames.tolist():
        drawn = torch.randperm(step.scene.frames, generator=step.random)[:TIMES]
        losses.append(track_loss(step, frame, drawn.to(step.scene.device)))
    return torch.stack(losses).mean()


def track_loss(step: FitStep, frame: int, times: Int[Tensor, " b"]) -> Float[Tensor, ""]:
    """Weighted mean distance, in shares of the picture's longer side, and a tenth of that of inverse depths.

    Tracks count where they are seen at both times, by their confidences and exp(-2 |dt| / T).
    """
    scene, targets = step.scene, step.targets
    tracks, camera = targets.priors.tracks, targets.view.camera
    rows = tracks.visible[:, frame].nonzero()[:, 0]
    if len(rows) == 0 or len(scene.moving) == 0:
        return scene.moving.means.sum() * 0
    positions, alpha = render_positions(scene, camera.select([frame]), frame, times, step.backend)
    start = tracks.xy[rows, frame]
    places = _sampled(torch.cat((positions.flatten(2), alpha[..., None]), -1), start)
    carried = places[:, :-1].unflatten(-1, (len(times), 3)).transpose(0, 1)
    xy, depth = project(transform_points(camera.camera_from_world[times], carried), camera.intrinsics[times])
    aim = tracks.xy[rows][:, times].transpose(0, 1)
    nearness = torch.exp(-2 * (times - frame).abs() / scene.frames)
    sure = tracks.confidence[rows, frame] * tracks.confidence[rows][:, times].T * nearness[:, None]
    counts = tracks.visible[rows][:, times].T & (places[:, -1] > LEAST_ALPHA) & (depth > 1e-6 * targets.distance)
    off = (xy - aim).abs().sum(-1) / max(camera.width, camera.height)
    row, column = nearest_pixel(aim, camera.width, camera.height)
    seen = targets.priors.depth[times[:, None], row, column]
    inverse = (1 / depth.where(counts, 1) - 1 / seen.where(seen > 0, 1)).abs() * targets.distance
    loss = _trimmed_mean(off[counts], sure[counts])
    known = counts & (seen > 0)
    return loss + DEPTH_WEIGHT * _trimmed_mean(inverse[known], sure[known])


def _sampled(image: Float[Tensor, "h w c"], xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Values between pixels, whose centres are at half-integers."""
    size = torch.tensor([image.shape[1], image.shape[0]], device=image.device)
    grid = (2 * xy / size - 1).to(image)[None, None]
    values = torch.nn.functional.grid_sample(
        image.movedim(-1, 0)[None], grid, padding_mode="border", align_corners=False
    )
    return values[0, :, 0].T


def _trimmed_mean(values: Float[Tensor, " n"], weights: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Weighted mean of the smallest values; 0 of none."""
    order = values.detach().argsort()[: max(1, round(KEPT * len(values)))]
    return (values[order] * weights[order]).sum() / weights[order].sum().clamp(min=1e-9)
