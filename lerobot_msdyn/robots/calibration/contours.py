"""Outlines of the links as a camera sees them, and how they move with the camera and the joints."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from numpy import ndarray

from lerobot_msdyn.render.cpu.threads import in_threads
from lerobot_msdyn.robots.calibration.search import Pose
from lerobot_msdyn.robots.description import Robot
from lerobot_msdyn.robots.kernels import draw_triangles, project_vertices, trace_edges
from lerobot_msdyn.robots.kinematics import link_poses

FAR = np.float32(1e6)
NORMAL_PX = 1.5  # over which an outline's direction is smoothed
REACH_PX, STEP_PX = 4.0, 0.5  # of the profiles across an outline
INSIDE_PX, OUTSIDE_PX = -1.5, 2.0  # beyond which a profile is taken as of the robot, and of what is behind
LEAST_CONTRAST = 8.0  # CIE Lab units between the two


@dataclass(frozen=True)
class Outline:
    """Points between the last pixel of a link and the first that is no robot."""

    frame: Int64[ndarray, " n"]
    xy: Float64[ndarray, "n 2"]  # px
    point: Float64[ndarray, "n 3"]  # m, in the robot's frame
    on_link: Float64[ndarray, "n 3"]  # m, in the link's
    link: Int32[ndarray, " n"]
    normal: Float64[ndarray, "n 2"]  # unit vectors in the picture, away from the robot

    def __len__(self) -> int:
        return len(self.frame)

    def thinned(self, count: int) -> "Outline":
        """At most so many of the points."""
        step = -(-len(self) // count) if len(self) else 1
        return Outline(*(getattr(self, name)[::step] for name in ("frame", "xy", "point", "on_link", "link", "normal")))


class Posed:
    """The robot in some frames."""

    def __init__(self, robot: Robot, values: Float64[ndarray, "t j"]) -> None:
        self.robot, self.values = robot, values
        self.links = link_poses(robot, torch.from_numpy(values)).numpy()
        self._vertex_link = np.zeros(len(robot.vertices), np.int32)
        self._vertex_link[robot.faces.reshape(-1)] = np.repeat(robot.face_link, 3)

    def __len__(self) -> int:
        return len(self.values)

    def axes(self) -> tuple[Float64[ndarray, "t j 3"], Float64[ndarray, "t j 3"], Bool[ndarray, " j"]]:
        """Axes of the movable joints and points on them in the robot's frame, and which joints turn."""
        robot = self.robot
        axes, origins = np.zeros((2, len(self), len(robot.movable), 3))
        turns = np.ones(len(robot.movable), bool)
        for index, name in enumerate(robot.movable):
            joint = robot.joint(name)
            pose = self.links[:, joint.parent] @ joint.parent_from_joint
            axes[:, index], origins[:, index] = pose[:, :3, :3] @ joint.axis, pose[:, :3, 3]
            turns[index] = joint.kind != "prismatic"
        return axes, origins, turns

    def drawn(
        self, frame: int, pose: Pose, width: int, height: int
    ) -> tuple[Float32[ndarray, "h w"], Int32[ndarray, "h w"]]:
        """z-depth (m, 0 = no robot) and link (-1 = no robot) of every pixel."""
        depth, index = self._buffers(frame, pose, width, height)
        link = np.where(index >= 0, self.robot.face_link[np.maximum(index, 0)], -1).astype(np.int32)
        return np.where(index >= 0, depth, 0).astype(np.float32), link

    def _buffers(
        self, frame: int, pose: Pose, width: int, height: int
    ) -> tuple[Float32[ndarray, "h w"], Int32[ndarray, "h w"]]:
        """z-depth (m) and face (-1 = no robot) of every pixel."""
        depth, index = np.full((height, width), FAR, np.float32), np.full((height, width), -1, np.int32)
        camera_from_robot = np.eye(4)
        camera_from_robot[:3, :3], camera_from_robot[:3, 3] = pose.rotation, pose.translation
        points = np.empty((len(self.robot.vertices), 3))
        posed, focal = camera_from_robot @ self.links[frame], pose.focal * width
        project_vertices(self.robot.vertices, self._vertex_link, posed, focal, width / 2, height / 2, points)
        draw_triangles(points, self.robot.faces, depth, index)
        return depth, index

    def outline(self, pose: Pose, size: tuple[int, int], moving: Bool[ndarray, " l"]) -> Outline:
        """Outlines of the moving links against what is no robot, in all frames.

        Args:
            pose: the camera.
            size: width and height, px.
            moving: the links whose outlines are wanted.
        """
        width, height = size
        solid = np.empty((len(self), height, width), np.float32)

        def traced(frame: int) -> Float64[ndarray, "n 4"]:
            depth, index = self._buffers(frame, pose, width, height)
            solid[frame] = cv2.GaussianBlur((index >= 0).astype(np.float32), (0, 0), NORMAL_PX)
            out = np.empty((width * height, 4))
            return out[: trace_edges(index, depth, self.robot.face_link, moving, out)].copy()

        parts = list(in_threads(traced, range(len(self))))
        frames = np.concatenate([np.full(len(part), frame) for frame, part in enumerate(parts)])
        x, y, z, link = np.concatenate(parts).T
        focal = pose.focal * width
        camera = np.stack([(x - width / 2) / focal * z, (y - height / 2) / focal * z, z], axis=1)
        point = (camera - pose.translation) @ pose.rotation
        links = self.links[frames, link.astype(np.int32)]
        on_link = np.einsum("nji,nj->ni", links[:, :3, :3], point - links[:, :3, 3])
        xy = np.stack([x, y], axis=1)
        _, slope = sampled(solid, frames, xy)
        normal = -slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
        return Outline(frames, xy, point, on_link, link.astype(np.int32), normal)

    def moved(self, outline: Outline, pose: Pose, size: tuple[int, int]) -> Outline:
        """The same points of the links, as the links and the camera are now; cheaper than an outline drawn anew."""
        links = self.links[outline.frame, outline.link]
        point = np.einsum("nij,nj->ni", links[:, :3, :3], outline.on_link) + links[:, :3, 3]
        camera = point @ pose.rotation.T + pose.translation
        xy = pose.focal * size[0] * camera[:, :2] / camera[:, 2:].clip(0.01) + np.array(size) / 2
        return replace(outline, xy=xy, point=point)


def jacobian(
    posed: Posed, pose: Pose, points: Outline, width: int
) -> tuple[Float64[ndarray, "n 2 7"], Float64[ndarray, "n 2 j"]]:
    """Movement of the outline's points in the picture (px): by `Pose.moved`, and by the joints' values."""
    camera = points.point @ pose.rotation.T + pose.translation
    x, y, z = camera.T
    focal, zero = pose.focal * width, np.zeros(len(z))
    project = np.stack(
        [np.stack([focal / z, zero, -focal * x / z**2], 1), np.stack([zero, focal / z, -focal * y / z**2], 1)], 1
    )
    turned = np.stack([np.stack([zero, z, -y], 1), np.stack([-z, zero, x], 1), np.stack([y, -x, zero], 1)], 1)
    by_focal = np.stack([focal * x / z, focal * y / z], 1)
    by_pose = np.concatenate([project @ turned, project, by_focal[:, :, None]], axis=2)
    axes, origins, turns = posed.axes()
    axis, origin = axes[points.frame], origins[points.frame]
    moved = np.where(turns[:, None], np.cross(axis, points.point[:, None] - origin), axis)
    moved = moved * posed.robot.moved_by[points.link][:, :, None]
    by_joints = project @ (moved @ pose.rotation.T).transpose(0, 2, 1)
    return by_pose, by_joints


def signed_distance(masks: Bool[ndarray, "t h w"]) -> Float32[ndarray, "t h w"]:
    """Distance (px) to the edge of each mask, which lies between pixels; positive outside."""
    out = np.empty(masks.shape, np.float32)
    for k, mask in enumerate(masks):
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        out[k] = np.where(mask, 0.5 - inside, outside - 0.5)
    return out


def sampled(
    fields: Float32[ndarray, "t h w"], frame: Int64[ndarray, " n"], xy: Float64[ndarray, "n 2"]
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, "n 2"]]:
    """Values of images at points (px, bilinear), and their slopes."""
    height, width = fields.shape[1:]
    x, y = (xy[:, 0] - 0.5).clip(0, width - 1.001), (xy[:, 1] - 0.5).clip(0, height - 1.001)
    column, row = x.astype(int), y.astype(int)
    fx, fy = x - column, y - row
    a, b = fields[frame, row, column], fields[frame, row, column + 1]
    c, d = fields[frame, row + 1, column], fields[frame, row + 1, column + 1]
    value = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
    slope = np.stack([(b - a) * (1 - fy) + (d - c) * fy, (c - a) * (1 - fx) + (d - b) * fx], axis=1)
    return value.astype(np.float64), slope.astype(np.float64)


def edges_across(
    difference: Float32[ndarray, "t h w"], points: Outline, scale: float
) -> tuple[Float64[ndarray, " n"], Bool[ndarray, " n"]]:
    """How far an outline lies outside of the edge that is next to it (px), and where there is one.

    The edge is where the difference to the empty scene falls below the mean of its sides: blur does not shift it, and
    a shadow, which differs less, is not taken for the robot.

    Args:
        difference: to the empty scene (CIE Lab units).
        points: the outline, about right.
        scale: width of the picture in widths of 320 px.
    """
    steps = np.arange(-REACH_PX, REACH_PX + STEP_PX / 2, STEP_PX)
    places = points.xy[:, None] + scale * steps[:, None] * points.normal[:, None]
    values, _ = sampled(difference, np.repeat(points.frame, len(steps)), places.reshape(-1, 2))
    profile = values.reshape(len(points), len(steps))
    inside = np.median(profile[:, steps <= INSIDE_PX], axis=1)
    outside = np.median(profile[:, steps >= OUTSIDE_PX], axis=1)
    above = profile > ((inside + outside) / 2)[:, None]
    last = len(steps) - 1 - above[:, ::-1].argmax(1)  # from outside, the first that is the robot
    usable = (inside - outside > LEAST_CONTRAST) & (last > 0) & (last < len(steps) - 1)
    last = last.clip(0, len(steps) - 2)
    rows = np.arange(len(points))
    high, low = profile[rows, last], profile[rows, last + 1]
    share = (high - (inside + outside) / 2) / np.maximum(high - low, 1e-6)
    return -scale * (steps[last] + STEP_PX * share.clip(0, 1)), usable
