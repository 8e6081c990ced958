"""How far each basis of a scene's motion can be doubted: by how many pixels it carries points beside their tracks."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import (
    nearest_pixel,
    project,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_matrix,
    transform_points,
    unproject,
)
from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.core.sampling import REFERENCE_WIDTH, evenly
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.compose import compose
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.scene.dynamic import DynamicScene

QUERY_FRAMES = 8  # in which tracks find the Gaussian that they belong to
TRACKS = 400  # of each
JUDGED_FRAMES = 30  # in which it is compared where it is carried


@torch.no_grad()
def doubts(scene: DynamicScene, camera: CameraTrack, priors: Priors, sure_px: float) -> list[Float[Tensor, " k"]]:
    """Per level the share, 0 to 1, by which each basis is to be learned: e^2 / (e^2 + sure_px^2).

    e is the median, over the tracks that follow the basis most, of `track_errors_px`; bases that no track follows
    (a robot's links, whose joints are known) are not to be learned. Without `sure_px` all are, at the full rate.

    Args:
        scene: on the host.
        camera: the recorded one.
        priors: tracks and depth, at the camera's size.
        sure_px: of pictures 320 wide.
    """
    counts = [len(level) if isinstance(level, MotionLevel) else 0 for level in scene.levels]
    if sure_px == 0:
        return [torch.ones(count) for count in counts]
    shares = [torch.zeros(count) for count in counts]
    if len(scene.moving) == 0 or len(priors.tracks) == 0:
        return shares
    gaussian, error = track_errors_px(scene, camera, priors)
    for share, index, logit in zip(shares, scene.indices, scene.logits, strict=True):
        if len(share) == 0:
            continue  # a level of another kind has no bases
        followed = index.gather(1, logit.argmax(1, keepdim=True))[gaussian, 0]
        for k in followed.unique().tolist():
            square = float(error[followed == k].median()) ** 2
            share[k] = square / (square + sure_px**2)
    return shares


def track_errors_px(
    scene: DynamicScene, camera: CameraTrack, priors: Priors
) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"]]:
    """The moving Gaussian nearest to each tracked point in some frames, and how far it carries it from its track.

    The median over the frames in which the track is seen, in pixels of pictures 320 wide.
    """
    tracks, moving = priors.tracks, scene.moving
    times = evenly(scene.frames, JUDGED_FRAMES)
    gaussians, errors = [torch.zeros(0, dtype=torch.long)], [torch.zeros(0)]
    for frame in evenly(scene.frames, QUERY_FRAMES).tolist():
        rows, points = _seen(tracks, priors, camera, frame)
        if len(rows) == 0:
            continue
        at = torch.cat((torch.tensor([frame]), times))
        there = scene.positions(at[:1])[0, len(scene.static) :]
        nearest = torch.cdist(points, there).argmin(1)
        chosen = scene.select_moving(nearest)
        means, quats = compose(
            moving.means[nearest], moving.quats[nearest], chosen.levels, chosen.indices, chosen.logits, at
        )
        turn = quaternion_to_matrix(quaternion_multiply(quats[1:], quaternion_conjugate(quats[:1])))
        carried = means[1:] + (turn @ (points - means[0])[..., None])[..., 0]
        xy, depth = project(transform_points(camera.camera_from_world[times], carried), camera.intrinsics[times])
        off = (xy - tracks.xy[rows][:, times].transpose(0, 1)).norm(dim=-1)
        judged = tracks.visible[rows][:, times].T & (depth > 0) & (times != frame)[:, None]
        error = torch.where(judged, off, torch.nan).nanmedian(0).values
        known = error.isfinite()
        gaussians.append(nearest[known])
        errors.append(error[known] * (REFERENCE_WIDTH / camera.width))
    return torch.cat(gaussians), torch.cat(errors)


def _seen(
    tracks: PointTracks, priors: Priors, camera: CameraTrack, frame: int
) -> tuple[Int[Tensor, " m"], Float[Tensor, "m 3"]]:
    """Some of the tracks that are seen at a frame where depth is known, and their points (m, in the world)."""
    height, width = priors.depth.shape[1:]
    xy = tracks.xy[:, frame]
    inside = (xy >= 0).all(-1) & (xy < torch.tensor([width, height])).all(-1)
    depth = priors.depth[frame][nearest_pixel(xy, width, height)]
    rows = (tracks.visible[:, frame] & inside & (depth > 0)).nonzero()[:, 0]
    rows = rows[evenly(len(rows), TRACKS)] if len(rows) else rows
    in_camera = unproject(xy[rows], depth[rows], camera.intrinsics[frame])
    return rows, transform_points(camera.world_from_camera[frame], in_camera)
