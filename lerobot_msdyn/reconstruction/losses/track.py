"""Where the scene carries what it shows at a tracked pixel, against where the track goes (the paper's L_track).

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

    What is compared is by how much a point goes from the frame to the other times. Where it is at the frame is off by
    up to a Gaussian: on a slanted surface nearer Gaussians hide those behind them, and blended positions lie towards
    the camera. Tracks count where they are seen at both times, by their confidences and exp(-2 |dt| / T).
    """
    scene, targets = step.scene, step.targets
    tracks, camera = targets.priors.tracks, targets.view.camera
    rows = tracks.visible[:, frame].nonzero()[:, 0]
    if len(rows) == 0 or len(scene.moving) == 0:
        return scene.moving.means.sum() * 0
    both = torch.cat((times.new_tensor([frame]), times))
    positions, alpha = render_positions(scene, camera.select([frame]), frame, both, step.backend)
    places = _sampled(torch.cat((positions.flatten(2), alpha[..., None]), -1), tracks.xy[rows, frame])
    carried = places[:, :-1].unflatten(-1, (len(both), 3)).transpose(0, 1)
    xy, depth = project(transform_points(camera.camera_from_world[both], carried), camera.intrinsics[both])
    tracked = tracks.xy[rows][:, both].transpose(0, 1)
    nearness = torch.exp(-2 * (times - frame).abs() / scene.frames)
    sure = tracks.confidence[rows, frame] * tracks.confidence[rows][:, times].T * nearness[:, None]
    drawn = (places[:, -1] > LEAST_ALPHA) & (depth > 1e-6 * targets.distance).all(0)
    counts = tracks.visible[rows][:, times].T & drawn
    off = (_gone(xy) - _gone(tracked)).abs().sum(-1) / max(camera.width, camera.height)
    row, column = nearest_pixel(tracked, camera.width, camera.height)
    seen = targets.priors.depth[both[:, None], row, column]
    inverse = _gone(1 / depth.where(drawn, 1)) - _gone(1 / seen.where(seen > 0, 1))
    known = counts & (seen[1:] > 0) & (seen[0] > 0)
    by_depth = _trimmed_mean((inverse * targets.distance).abs()[known], sure[known])
    return _trimmed_mean(off[counts], sure[counts]) + DEPTH_WEIGHT * by_depth


def _gone(values: Float[Tensor, "s *any"]) -> Float[Tensor, "b *any"]:
    """From the first time to the others."""
    return values[1:] - values[:1]


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
