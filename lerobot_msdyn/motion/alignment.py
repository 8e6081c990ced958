"""One frame's depth, picture and masks, and how rigid parts are aligned to them by Gauss-Newton steps."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.cameras import CameraTrack
from lerobot_msdyn.geometry import axis_angle_to_matrix, project, se3, transform_points, unproject
from lerobot_msdyn.motion.lift import near_depth_edge

_SLOPE_REACH_PX = 2  # to either side, over which normals are taken, and 1 for gradients
_STEPS = 2
_LONGEST_STEP_PX = 3.0
_BEHIND_PX = 8.0  # a point farther than this from the recorded surface is hidden, or the surface is another one
_IN_FRONT_PX = 3.0  # a point no farther than this behind what stands still should have been seen
_FACING = 0.2  # least cosine between a normal and the view
_ALIKE = 0.5  # least cosine between the normals of a point and of the surface that it meets
_OUTLINE_PX = 8.0  # farther outside the masks a point tells nothing
_SIGMAS = (0.5, 8.0, 1.0)  # px of depth, grey levels, px outside the masks
_OUTLIER = 3.0  # sigmas at which three quarters of the weight are lost (Geman-McClure)
_CORRELATED = 8.0  # neighbouring points, which err alike and count as one
_TRACKS_SIGMA_PX = 5.0  # error of motions that come from tracks


@dataclass(frozen=True)
class Frame:
    """What one frame shows."""

    depth: Float[Tensor, "h w"]  # m
    known: Bool[Tensor, "h w"]  # where depth and normals can be relied on
    grey: Float[Tensor, "h w"]  # 0..255
    outside: Float[Tensor, "h w"]  # px to the nearest moving pixel
    instances: UInt8[Tensor, "h w"]
    camera: CameraTrack  # one frame
    pixel_m: float  # size of a pixel where things move

    def xyz(self, row: Int[Tensor, " n"], column: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """World points (m) of some pixels."""
        xy = torch.stack((column, row), dim=-1) + 0.5
        points = unproject(xy, self.depth[row, column], self.camera.intrinsics[0])
        return transform_points(self.camera.world_from_camera[0], points)

    def normals(self, row: Int[Tensor, " n"], column: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Unit normals in the world, towards the camera."""
        (left, right), (up, down) = _beside(self.depth, row, column, _SLOPE_REACH_PX)
        across = self.xyz(row, right) - self.xyz(row, left)
        return torch.nn.functional.normalize(
            torch.linalg.cross(self.xyz(down, column) - self.xyz(up, column), across), dim=-1
        )


@dataclass(frozen=True)
class Model:
    """Points of the parts at the canonical frame."""

    points: Float[Tensor, "n 3"]  # m
    normals: Float[Tensor, "n 3"]
    grey: Float[Tensor, " n"]
    part: Int[Tensor, " n"]


@dataclass(frozen=True)
class Terms:
    """Residuals of depth, colour and outline, in standard deviations."""

    residuals: Float[Tensor, "3 n"]
    weights: Float[Tensor, "3 n"]  # robust; 0 where there is nothing to compare with
    gradients: Float[Tensor, "3 n 3"]  # by the point in the world, per m
    points: Float[Tensor, "n 3"]  # m, in the world


def read_frame(
    rgb: UInt8[Tensor, "h w 3"],
    depth: Float[Tensor, "h w"],
    instances: UInt8[Tensor, "h w"],
    camera: CameraTrack,
    pixel_m: float,
) -> Frame:
    """The maps of one frame."""
    side = 2 * _SLOPE_REACH_PX + 1
    known = cv2.erode((depth > 0).numpy().astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb.numpy(), cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    outside = cv2.distanceTransform((instances == 0).numpy().astype(np.uint8), cv2.DIST_L2, 5)
    reliable = torch.from_numpy(known & ~near_depth_edge(depth.numpy()))
    return Frame(depth, reliable, torch.from_numpy(grey), torch.from_numpy(outside), instances, camera, pixel_m)


def compare(model: Model, motions: Float[Tensor, "k 4 4"], frame: Frame) -> Terms:
    """A model, moved to a frame, against what is seen there.

    Depth: distance from the recorded surface along its normal (point to plane, Chen and Medioni 1992), by projection.
    Colour: grey, but for the part's mean difference. Outline: distance outside the masks, of points which nothing that
    stands still can hide.
    """
    moves = motions[model.part]
    points = transform_points(moves, model.points[:, None])[:, 0]
    normals = (moves[:, :3, :3] @ model.normals[..., None])[..., 0]
    view = frame.camera.camera_from_world[0]
    in_camera = transform_points(view, points)
    xy, z = project(in_camera, frame.camera.intrinsics[0])
    height, width = frame.depth.shape
    column, row = xy.floor().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 0)
    column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    away = points - frame.camera.world_from_camera[0, :3, 3]
    shown = inside & (-(away * normals).sum(-1) > _FACING * away.norm(dim=-1))

    surface, surface_normals = frame.xyz(row, column), frame.normals(row, column)
    offset = points - surface
    moving = frame.instances[row, column] > 0
    met = shown & moving & frame.known[row, column] & ((surface_normals * normals).sum(-1) > _ALIKE)
    met &= offset.norm(dim=-1) < _BEHIND_PX * frame.pixel_m
    recorded = frame.depth[row, column]
    outside = frame.outside[row, column]
    in_front = (z < recorded + _IN_FRONT_PX * frame.pixel_m) | (recorded == 0)
    stray = shown & ~moving & in_front & (outside < _OUTLINE_PX)

    slope = _slope(frame.grey, row, column)
    within = xy - torch.stack((column, row), dim=-1) - 0.5
    grey = frame.grey[row, column] + (slope * within).sum(-1) - model.grey
    count = torch.zeros(len(motions)).index_add_(0, model.part, met.float()).clamp(min=1)
    mean = torch.zeros(len(motions)).index_add_(0, model.part, met * grey) / count
    depth_sigma = _SIGMAS[0] * frame.pixel_m
    residuals = torch.stack(
        (
            (surface_normals * offset).sum(-1) / depth_sigma,
            (grey - mean[model.part]) / _SIGMAS[1],
            outside / _SIGMAS[2],
        )
    )
    robust = 1 / (1 + (residuals / _OUTLIER).square()).square()
    robust[2] = 1
    lines = torch.stack((slope / _SIGMAS[1], _slope(frame.outside, row, column) / _SIGMAS[2]))
    gradients = torch.cat(((surface_normals / depth_sigma)[None], _by_point(lines, in_camera, frame)))
    return Terms(residuals, robust * torch.stack((met, met, stray)), gradients, points)


def align(
    model: Model,
    motions: Float[Tensor, "k 4 4"],
    tracked: Float[Tensor, "k 4 4"],
    pivots: Float[Tensor, "k 3"],
    reach: Float[Tensor, " k"],
    frame: Frame,
) -> Float[Tensor, "k 4 4"]:
    """Motions after some Gauss-Newton steps towards what a frame shows, held by those from tracks.

    The unknowns are a turn about the moved pivot, times the part's `reach` (m), and a shift: all in m.
    """
    count = len(motions)
    unit = torch.cat((1 / reach[:, None].expand(-1, 3), torch.ones(count, 3)), dim=1)
    hold = 1 / (_TRACKS_SIGMA_PX * frame.pixel_m) ** 2
    longest = _LONGEST_STEP_PX * frame.pixel_m
    start = transform_points(tracked, pivots[:, None])[:, 0]
    for _ in range(_STEPS):
        terms = compare(model, motions, frame)
        pivot = transform_points(motions, pivots[:, None])[:, 0]
        arm = (terms.points - pivot[model.part]).expand_as(terms.gradients)
        jacobian = torch.cat((torch.linalg.cross(arm, terms.gradients), terms.gradients), dim=-1) * unit[model.part]
        weighted = terms.weights[..., None] * jacobian / _CORRELATED
        square = torch.einsum("cni,cnj->nij", weighted, jacobian)
        slope = torch.einsum("cni,cn->ni", weighted, terms.residuals)
        hessian = hold * torch.eye(6).repeat(count, 1, 1)
        hessian.index_add_(0, model.part, square)
        turned = motions[:, :3, :3] @ tracked[:, :3, :3].transpose(1, 2)
        gone = torch.cat((_small_turn(turned), pivot - start), dim=1) / unit
        gradient = (hold * gone).index_add_(0, model.part, slope)
        step = -torch.linalg.solve(hessian, gradient).clamp(-longest, longest) * unit
        rotation = axis_angle_to_matrix(step[:, :3]) @ motions[:, :3, :3]
        motions = se3(rotation, pivot + step[:, 3:] - (rotation @ pivots[..., None])[..., 0])
    return motions


def _small_turn(rotations: Float[Tensor, "k 3 3"]) -> Float[Tensor, "k 3"]:
    """Rotation vectors of small rotations."""
    skew = (rotations - rotations.transpose(1, 2)) / 2
    return torch.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), dim=-1)


def _by_point(slopes: Float[Tensor, "c n 2"], in_camera: Float[Tensor, "n 3"], frame: Frame) -> Float[Tensor, "c n 3"]:
    """Gradients by the world point (per m) from gradients by the pixel (per px)."""
    focal = frame.camera.intrinsics[0].diagonal()[:2]
    x, y, z = in_camera.unbind(-1)
    by_x, by_y = (slopes * focal).unbind(-1)
    z = z.clamp(min=1e-6)
    by_camera = torch.stack((by_x / z, by_y / z, -(by_x * x + by_y * y) / z.square()), dim=-1)
    return by_camera @ frame.camera.camera_from_world[0, :3, :3]


def _slope(image: Float[Tensor, "h w"], row: Int[Tensor, " n"], column: Int[Tensor, " n"]) -> Float[Tensor, "n 2"]:
    """Central differences by x and y, per px."""
    (left, right), (up, down) = _beside(image, row, column, 1)
    across = (image[row, right] - image[row, left]) / (right - left)
    return torch.stack((across, (image[down, column] - image[up, column]) / (down - up)), dim=-1)


def _beside(
    image: Float[Tensor, "h w"], row: Int[Tensor, " n"], column: Int[Tensor, " n"], reach: int
) -> tuple[tuple[Int[Tensor, " n"], Int[Tensor, " n"]], tuple[Int[Tensor, " n"], Int[Tensor, " n"]]]:
    """Columns to the left and right, and rows above and below, inside the image."""
    height, width = image.shape
    columns = ((column - reach).clamp(min=0), (column + reach).clamp(max=width - 1))
    return columns, ((row - reach).clamp(min=0), (row + reach).clamp(max=height - 1))
