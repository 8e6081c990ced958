"""What a video shows, points gathered from it, and how rigid parts are aligned to it by Gauss-Newton steps."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import invert_se3, transform_points, unproject
from lerobot_msdyn.core.sampling import evenly, scaled_px, scaled_window
from lerobot_msdyn.motion.from_tracks.lift import near_depth_edge
from lerobot_msdyn.motion.to_video.kernels import OUTSIDE_UNIT, REACH_PX, Maps, Points, align_poses, frame_costs
from lerobot_msdyn.render.cpu.threads import run

_BORDER_PX = 2  # of 320, of the masks, without points
_STEPS = 2  # of Gauss-Newton
_LONGEST_STEP_PX = 3.0
_TRACKS_SIGMA_PX = 5.0  # error of motions that come from tracks
_LEAST_REACH_M = 1e-3


@dataclass(frozen=True)
class Video:
    """The maps of all frames, and the camera that saw them."""

    maps: Maps
    instances: UInt8[Tensor, "t h w"]
    camera: CameraTrack

    def __len__(self) -> int:
        return len(self.instances)

    @property
    def pixel_m(self) -> float:
        """Size of a pixel (m) where things move."""
        return self.maps.pixel_m


@dataclass(frozen=True)
class Sightings:
    """Points of what moves, each as one frame shows it."""

    xyz: Float[Tensor, "n 3"]  # m, in the world
    normals: Float[Tensor, "n 3"]  # towards the camera
    grey: Float[Tensor, " n"]  # 0..255
    frame: Int[Tensor, " n"]
    instance: Int[Tensor, " n"]

    def __len__(self) -> int:
        return len(self.frame)

    def at_canonical(
        self, motions: Float[Tensor, "k t 4 4"], part: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Points (m) and normals carried back by the motions of their parts."""
        back = invert_se3(motions[part, self.frame])
        points = transform_points(back, self.xyz[:, None].to(back))[:, 0]
        return points, (back[:, :3, :3] @ self.normals[..., None].to(back))[..., 0]


def read_video(
    rgb: UInt8[Tensor, "t h w 3"],
    depth: Float[Tensor, "t h w"],
    instances: UInt8[Tensor, "t h w"],
    camera: CameraTrack,
    pixel_m: float,
) -> Video:
    """The maps of a video: depth in m (0 = unknown), instances (0 = what stands still)."""
    reliable, outside = np.zeros(depth.shape, bool), np.zeros(depth.shape, np.uint8)
    grey = np.zeros(depth.shape, np.uint8)
    window = np.ones((2 * REACH_PX + 1,) * 2, np.uint8)
    for t, (picture, z, labels) in enumerate(zip(rgb.numpy(), depth.numpy(), instances.numpy(), strict=True)):
        reliable[t] = (cv2.erode((z > 0).astype(np.uint8), window) > 0) & ~near_depth_edge(z)
        grey[t] = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        distance = cv2.distanceTransform((labels == 0).astype(np.uint8), cv2.DIST_L2, 5)
        unit = OUTSIDE_UNIT / scaled_px(1, labels.shape[1])
        outside[t] = np.minimum(distance, 255 / unit) * unit  # without any label the distance is the largest float
    maps = Maps(depth.numpy(), reliable, grey, outside, camera.intrinsics.float().contiguous().numpy(), pixel_m)
    return Video(maps, instances, camera)


def sight(video: Video, frames: list[int], most: int) -> Sightings:
    """Points of some frames, `most` of each, inside the masks and where depth and normals can be relied on."""
    window = scaled_window(_BORDER_PX, video.instances.shape[2])
    gathered = [(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), *torch.zeros(2, 0, dtype=torch.long))]
    for t in frames:
        labels = video.instances[t]
        inner = cv2.erode((labels > 0).numpy().astype(np.uint8), window) > 0
        rows = np.argwhere(inner & video.maps.reliable[t])
        rows = rows[evenly(len(rows), most).numpy()]
        row, column = torch.from_numpy(rows).unbind(-1)
        depth = torch.from_numpy(video.maps.depth[t])
        pose = video.camera.world_from_camera[t]
        normals = _normals(depth, row, column, video.camera.intrinsics[t]) @ pose[:3, :3].T
        xyz = transform_points(pose, _in_camera(depth, row, column, video.camera.intrinsics[t]))
        grey = torch.from_numpy(video.maps.grey[t])[row, column].float()
        gathered.append((xyz, normals, grey, torch.full_like(row, t), labels[row, column].long()))
    return Sightings(*(torch.cat(each) for each in zip(*gathered, strict=True)))


def align(
    video: Video,
    sightings: Sightings,
    part: Int[Tensor, " n"],
    motions: Float[Tensor, "k t 4 4"],
    held: Float[Tensor, "k t 4 4"],
) -> Float[Tensor, "k t 4 4"]:
    """Motions (float64) after some Gauss-Newton steps towards what the video shows.

    Residuals have robust weights. Depth: distance from the recorded surface along its normal (point to plane, Chen and
    Medioni 1992), by projection. Colour: grey, but for the part's mean difference. Outline: distance outside the
    masks, of points which nothing that stands still can hide. `held` are motions from tracks, by which these are held
    loosely.
    """
    order = part.argsort(stable=True)
    points, normals = sightings.at_canonical(motions, part)
    pivots, reach = centres(points, part, len(motions))
    sorted_points = Points(
        points[order].float().numpy(),
        normals[order].float().numpy(),
        sightings.grey[order].numpy(),
        np.searchsorted(part[order].numpy(), np.arange(len(motions) + 1)),
    )
    view = video.camera.camera_from_world.double()
    poses = (view @ motions).contiguous().numpy()
    held_poses = (view @ held).contiguous().numpy()
    pixel_m = video.pixel_m
    run(
        align_poses,
        len(video),
        poses,
        held_poses,
        1 / (_TRACKS_SIGMA_PX * pixel_m) ** 2,
        pivots.numpy(),
        reach.numpy(),
        sorted_points,
        video.maps,
        _STEPS,
        _LONGEST_STEP_PX * pixel_m,
    )
    return invert_se3(view) @ torch.from_numpy(poses)


def centres(
    points: Float[Tensor, "n 3"], part: Int[Tensor, " n"], count: int
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, " k"]]:
    """Mean of each part's points, and their root mean square distance (m) from it."""
    number = torch.bincount(part, minlength=count).to(points).clamp(min=1)
    middle = torch.zeros(count, 3).to(points).index_add_(0, part, points) / number[:, None]
    square = (points - middle[part]).square().sum(-1)
    spread = torch.zeros(count).to(points).index_add_(0, part, square) / number
    return middle, spread.sqrt().clamp(min=_LEAST_REACH_M)


def carried_costs(
    video: Video, sightings: Sightings, motions: Float[Tensor, "k t 4 4"], frames: Int[Tensor, " f"]
) -> Float[Tensor, "n k"]:
    """How badly each point fits some frames if it follows each of the motions: 0 (agrees) to 1 (contradicts)."""
    view = video.camera.camera_from_world[frames].double()
    costs = []
    for k in range(len(motions)):
        part = torch.full_like(sightings.frame, k)
        points, normals = sightings.at_canonical(motions, part)
        poses = view @ motions[k, frames].double()
        moved = transform_points(poses, points.expand(len(frames), -1, -1))
        turned = normals @ poses[:, :3, :3].transpose(1, 2)
        costs.append(costs_in_camera(video, moved, turned, sightings.grey, frames))
    return torch.stack(costs, dim=1)


def costs_in_camera(
    video: Video,
    points: Float[Tensor, "f n 3"],
    normals: Float[Tensor, "f n 3"],
    grey: Float[Tensor, " n"],
    frames: Int[Tensor, " f"],
) -> Float[Tensor, " n"]:
    """Mean cost of points in the cameras of some frames."""
    arrays = (each.float().contiguous().numpy() for each in (points, normals, grey))
    costs = torch.empty(points.shape[:2])
    run(frame_costs, len(frames), *arrays, frames.numpy(), video.maps, costs.numpy())
    return costs.mean(0)


def _in_camera(
    depth: Float[Tensor, "h w"], row: Int[Tensor, " n"], column: Int[Tensor, " n"], intrinsics: Float[Tensor, "3 3"]
) -> Float[Tensor, "n 3"]:
    return unproject(torch.stack((column, row), dim=-1) + 0.5, depth[row, column], intrinsics)


def _normals(
    depth: Float[Tensor, "h w"], row: Int[Tensor, " n"], column: Int[Tensor, " n"], intrinsics: Float[Tensor, "3 3"]
) -> Float[Tensor, "n 3"]:
    """Unit normals in the camera, towards it."""
    height, width = depth.shape
    left, right = (column - REACH_PX).clamp(min=0), (column + REACH_PX).clamp(max=width - 1)
    up, down = (row - REACH_PX).clamp(min=0), (row + REACH_PX).clamp(max=height - 1)
    across = _in_camera(depth, row, right, intrinsics) - _in_camera(depth, row, left, intrinsics)
    along = _in_camera(depth, down, column, intrinsics) - _in_camera(depth, up, column, intrinsics)
    return torch.nn.functional.normalize(torch.linalg.cross(along, across), dim=-1)
