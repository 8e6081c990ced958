"""What the scene does not explain of some frames is carried to the frames around them, as far as these agree."""

import logging
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from lerobot_msdyn.core.bits import packed_rows
from lerobot_msdyn.core.geometry import quaternion_conjugate, quaternion_multiply, quaternion_to_matrix
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.core.sampling import scaled_px
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.core.visibility import projected
from lerobot_msdyn.motion.model.compose import compose_points
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.unexplained import COLOUR_ERROR, SMOOTH_PX, Comparison, blurred
from lerobot_msdyn.render.cpu.threads import each_on
from lerobot_msdyn.scene.dynamic import DynamicScene, Snapshot
from lerobot_msdyn.scene.overlay import FramePatch
from lerobot_msdyn.scene.short_lived import STILL, ShortLived

logger = logging.getLogger(__name__)

AGREES = 1.3  # times the colour error from which on a pixel is unexplained: so far may a carried one be off
AROUND_PX = 3.0  # of 320: standard deviation of the average by which pixels choose together what carries them
IN_FRONT = 1.0  # what standing before the recorded surface counts, as an error of colour
BEHIND = 0.3  # and behind it, where it may be hidden
INVERSIONS = 2  # steps in which a point is traced back to the canonical frame
FAINT = 1e-3  # weight by which nothing is divided
_ONE_BLOCK = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Born:
    """The short-lived Gaussians of one frame."""

    patch: FramePatch  # as that frame sees them
    means: Float[Tensor, "n 3"]  # m, at the canonical frame
    quats: Float[Tensor, "n 4"]
    carrier: Int[Tensor, " n"]
    shown: dict[int, Bool[Tensor, " n"]]  # by frame


def key_frames(frames: int, reach: int) -> range:
    """Those of a video whose unexplained pixels become short-lived Gaussians that reach so many frames either way."""
    return range(min(reach, frames - 1), frames, 2 * reach)


def short_lived_of(scene: DynamicScene, view: View, priors: Priors, reach: int, backend: str = "auto") -> ShortLived:
    """What every (2 reach)th frame shows and the scene does not explain, for up to `reach` frames to either side.

    Each pixel becomes a Gaussian that takes the motion of the nearest one of the moving set, or stands still, whichever
    the frames around confirm over some pixels. It is shown at those of them, without a gap, whose recorded colour and
    depth agree and where the scene alone is wrong; the scene's own Gaussians are not rendered there.

    Args:
        scene: fitted, without patches; on any device, the result is on the host.
        view: the video, at the size at which it was fitted.
        priors: its depth.
        reach: frames, at least 1.
        backend: of the rasterizer.
    """
    comparison, host, count = Comparison(scene, view, priors, backend), to_device(scene, "cpu"), len(view.rgb)
    wrong = [*each_on(scene.device, lambda frame: comparison.wrong(comparison.snapshot(frame), frame), range(count))]
    keys = key_frames(count, reach)
    born = [*each_on(scene.device, lambda key: _born(comparison, host, key, reach, wrong), keys)]
    shown = [_shown(born, frame) for frame in range(count)]
    own = len(scene.static) + len(scene.moving)
    unhidden = ShortLived(
        means=torch.cat([one.means for one in born]),
        quats=torch.cat([one.quats for one in born]).to(torch.float16),
        log_scales=torch.cat([one.patch.log_scales for one in born]).to(torch.float16),
        rgb=torch.cat([one.patch.rgb for one in born]).to(torch.float16),
        carrier=torch.cat([one.carrier for one in born]).int(),
        first=torch.tensor([0, *(len(rows) for rows in shown)]).cumsum(0),
        shown=torch.cat(shown).int(),
        hidden=packed_rows([torch.zeros(own, dtype=torch.bool)] * count),
    )
    with_them = replace(host, short_lived=unhidden)

    def hidden(frame: int) -> Bool[Tensor, " g"]:
        if frame in keys:
            return born[keys.index(frame)].patch.hidden
        patch = with_them.short_lived_patch(frame)
        assert patch is not None
        covered = torch.from_numpy(_covered(patch.means, comparison, frame) & wrong[frame])
        moving = scene.positions(torch.tensor([frame]))[0, len(scene.static) :]
        return comparison.hidden(moving, frame, covered, covered)

    found = replace(unhidden, hidden=packed_rows([*each_on(scene.device, hidden, range(count))]))
    each = len(found.shown) / max(len(found.means), 1)
    logger.info("short-lived: %d Gaussians, each shown at %.1f frames", len(found.means), each)
    return found


def _born(comparison: Comparison, host: DynamicScene, key: int, reach: int, wrong: list[Bool[ndarray, "h w"]]) -> Born:
    """Those of one frame, carried by what the frames around confirm."""
    taken = comparison.taken(wrong[key], key)
    snapshot = comparison.snapshot(key)
    patch = comparison.patch(snapshot, key, wrong[key], taken)
    still = torch.full((len(patch),), STILL)
    trials = [(patch.means, patch.quats, still)]
    if len(host.moving) > 0 and len(patch) > 0:
        trials.append(_carried(host, to_device(snapshot, "cpu"), patch, key))
    around = [frame for frame in range(key - reach, key + reach + 1) if 0 <= frame < len(wrong) and frame != key]
    costs, agreeing = [], []
    for means, _, carrier in trials:
        cost, agrees = np.zeros(taken.shape, np.float32), {}
        for frame in around:
            where = means if carrier is still else _at(host, means, carrier, frame)
            missed, agrees[frame] = _compared(comparison, where, key, frame, taken, wrong[frame])
            cost[taken] += missed
        costs.append(_averaged(cost, taken, scaled_px(AROUND_PX, taken.shape[1])))
        agreeing.append(agrees)
    best = torch.from_numpy(np.argmin(np.stack(costs), axis=0))

    def chosen(values: list[Tensor]) -> Tensor:
        return torch.stack(values)[best, torch.arange(len(best))]

    means, quats, carrier = (chosen([*each]) for each in zip(*trials, strict=True))
    shown = {key: torch.ones(len(patch), dtype=torch.bool)}
    for step in (-1, 1):
        alive = shown[key]
        for frame in range(key + step, key + step * (reach + 1), step):
            if frame in around:
                shown[frame] = alive = alive & chosen([agrees[frame] for agrees in agreeing])
    return Born(patch, means, quats, carrier, shown)


def _carried(
    host: DynamicScene, snapshot: Snapshot, patch: FramePatch, key: int
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"], Int[Tensor, " n"]]:
    """Canonical positions (m) and orientations of the Gaussians of a frame, each by the nearest of the moving set."""
    means, quats = snapshot.means[0], snapshot.quats[0]
    carrier = torch.from_numpy(cKDTree(means.numpy()).query(patch.means.numpy())[1])
    turned = quaternion_multiply(quats[carrier], quaternion_conjugate(host.moving.quats[carrier]))
    turned = torch.nn.functional.normalize(turned, dim=-1)
    back = quaternion_to_matrix(turned).transpose(1, 2)
    canonical = host.moving.means[carrier] + (back @ (patch.means - means[carrier])[..., None])[..., 0]
    for _ in range(INVERSIONS):
        off = patch.means - _at(host, canonical, carrier, key)
        canonical = canonical + (back @ off[..., None])[..., 0]
    return canonical, quaternion_multiply(quaternion_conjugate(turned), patch.quats), carrier


def _at(
    host: DynamicScene, means: Float[Tensor, "n 3"], carrier: Int[Tensor, " n"], frame: int
) -> Float[Tensor, "n 3"]:
    """Where canonical points (m) are at a frame that move as some of the moving set do."""
    return compose_points(means, host.levels, *host.followed_by(carrier), torch.tensor([frame]))[0]


def _compared(
    comparison: Comparison,
    points: Float[Tensor, "n 3"],
    key: int,
    frame: int,
    taken: Bool[ndarray, "h w"],
    wrong: Bool[ndarray, "h w"],
) -> tuple[Float[ndarray, " n"], Bool[Tensor, " n"]]:
    """How far from what a frame shows the pixels taken from another are, were they at some points (m); who agrees."""
    rgb, seen = comparison.view.rgb, projected(points, comparison.view.camera.select([frame]))
    before, there = rgb[key][torch.from_numpy(taken)].float(), rgb[frame][seen.pixel].float()
    error = np.zeros(taken.shape, np.float32)
    error[taken] = ((there - before).abs().mean(-1) / 255).where(seen.inside, torch.ones(())).numpy()
    off = _averaged(error, taken, scaled_px(SMOOTH_PX, taken.shape[1]))
    behind = (seen.z / comparison.depth(frame)[seen.pixel] - 1).numpy()
    missed = off + IN_FRONT * (behind < -comparison.tolerance) + BEHIND * (behind > comparison.tolerance)
    agrees = (off < AGREES * COLOUR_ERROR) & (np.abs(behind) <= comparison.tolerance) & wrong[seen.pixel]
    return missed, torch.from_numpy(agrees)


def _averaged(values: Float[ndarray, "h w"], taken: Bool[ndarray, "h w"], sigma_px: float) -> Float[ndarray, " n"]:
    """At each pixel that is taken, the average over those around it."""
    return (blurred(values, sigma_px) / np.maximum(blurred(taken, sigma_px), FAINT))[taken]


def _covered(points: Float[Tensor, "n 3"], comparison: Comparison, frame: int) -> Bool[ndarray, "h w"]:
    """Where points (m) lie on what a frame shows, without the gaps of a pixel between them."""
    seen = projected(points, comparison.view.camera.select([frame]))
    depth = comparison.depth(frame)
    on = seen.inside & ((seen.z / depth[seen.pixel] - 1).abs() <= comparison.tolerance)
    covered = np.zeros(depth.shape, np.uint8)
    covered[tuple(index[on].numpy() for index in seen.pixel)] = 1
    return cv2.morphologyEx(covered, cv2.MORPH_CLOSE, _ONE_BLOCK) > 0


def _shown(born: list[Born], frame: int) -> Int[Tensor, " m"]:
    """The rows, among those of all, that a frame shows."""
    rows, first = [torch.zeros(0, dtype=torch.long)], 0
    for one in born:
        if frame in one.shown:
            rows.append(first + one.shown[frame].nonzero()[:, 0])
        first += len(one.carrier)
    return torch.cat(rows)
