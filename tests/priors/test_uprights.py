"""What stands on a known ground, told by vertical edges: a box, a mat that lies, and a wall, seen by a camera above."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy import ndarray

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import BodyTracks, RobotSeen, View
from lerobot_msdyn.priors.depth.table_plane import ground_plane
from lerobot_msdyn.priors.depth.uprights import (
    BEHIND_GROUND,
    Upright,
    empty_picture,
    empty_scene,
    still_error,
    vertical_edges,
    wall_m,
)

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
FINE = 3  # rays per pixel and axis
CAMERA_M = 0.4
WALL_M = 1.3
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
BROWN, RED, GREEN, GREY = (120, 80, 50), (200, 30, 40), (40, 150, 60), (150, 150, 170)


@dataclass(frozen=True)
class Desk:
    """What a camera at (0, 0, CAMERA_M) that looks along x, tilted downwards, has before it."""

    box: tuple[float, float, float, float] = (0.75, -0.12, 0.06, 0.12)  # front, left, right, height (m)
    mat: bool = True
    tilt_deg: float = 30.0

    def seen(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Picture, z-depth (m), which surface (0 ground, 1 mat, 2 box, 3 wall), pose."""
        pose = self.pose()
        v, u = (np.mgrid[: FINE * HEIGHT, : FINE * WIDTH] + 0.5) / FINE
        rays = np.stack(((u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)), -1) @ pose[:3, :3].T
        with np.errstate(divide="ignore"):
            ground = np.where(rays[..., 2] < 0, -CAMERA_M / rays[..., 2], np.inf)
            z = np.minimum(ground, WALL_M / rays[..., 0])
        surface = np.where(z < ground, 3, 0)
        front, left, right, high = self.box
        for at in (front / rays[..., 0], (high - CAMERA_M) / rays[..., 2]):  # its front, its top
            x, y, up = (rays[..., axis] * at + offset for axis, offset in ((0, 0), (1, 0), (2, CAMERA_M)))
            on = (x > front - 1e-6) & (x < front + 0.1) & (y > left) & (y < right) & (up > 0) & (up < high + 1e-6)
            nearer = on & (at > 0) & (at < z)
            z, surface = np.where(nearer, at, z), np.where(nearer, 2, surface)
        x, y = rays[..., 0] * z, rays[..., 1] * z
        if self.mat:
            surface = np.where((surface == 0) & (x > 0.45) & (x < 0.62) & (abs(y + 0.3 * (x - 0.5)) < 0.1), 1, surface)
        colours = np.array([BROWN, GREEN, RED, GREY])[surface]
        picture = colours.reshape(HEIGHT, FINE, WIDTH, FINE, 3).mean((1, 3))
        picture += np.random.default_rng(0).normal(0, 3, picture.shape)
        middle = np.s_[FINE // 2 :: FINE, FINE // 2 :: FINE]
        return picture.clip(0, 255).astype(np.uint8), z[middle], surface[middle], pose

    def pose(self) -> ndarray:
        tilt = np.radians(self.tilt_deg)
        ahead, right = np.array([np.cos(tilt), 0, -np.sin(tilt)]), np.array([0, -1.0, 0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack((right, np.cross(ahead, right), ahead), 1)
        pose[2, 3] = CAMERA_M
        return pose


def depth_of(picture: ndarray, pose: ndarray, hidden: ndarray | None = None) -> tuple[ndarray, ndarray]:
    """The empty scene's depth, and the ground's."""
    frames = 3
    rgb = torch.from_numpy(picture).expand(frames, -1, -1, -1).contiguous()
    intrinsics, poses = (torch.from_numpy(each).float().expand(frames, -1, -1).contiguous() for each in (K, pose))
    camera = CameraTrack(intrinsics, poses, WIDTH, HEIGHT, origin="calibration")
    ground = ground_plane(camera, 0.0)
    instances = torch.zeros(frames, HEIGHT, WIDTH, dtype=torch.uint8)
    if hidden is not None:
        instances[:, torch.from_numpy(hidden)] = 1
    unmoved = torch.zeros(frames, HEIGHT, WIDTH)
    nothing = BodyTracks(torch.zeros(0, frames, 3), torch.zeros(0, frames) > 0, torch.zeros(0).long())
    robot = RobotSeen(unmoved, unmoved > 0, nothing, 0.0)
    return empty_scene(View(rgb, camera), robot, ground, instances).numpy(), ground.numpy()


def test_a_box_stands_and_a_mat_lies() -> None:
    picture, z, surface, pose = Desk().seen()
    depth, ground = depth_of(picture, pose)
    off, off_before = abs(depth / z - 1), abs(ground / z - 1)
    assert off_before[surface == 2].mean() > 0.2
    assert off[surface == 2].mean() < 0.03
    assert off[(surface == 0) | (surface == 1)].mean() < 0.005
    assert (depth <= ground + 1e-6).all()


def test_the_wall_is_behind_where_the_ground_usually_ends() -> None:
    """By columns whose end is seen, and no farther than the assumed one."""
    distance = np.repeat(np.linspace(2.0, 0.5, 16)[:, None], 10, 1)
    behind = np.zeros((16, 10), bool)
    behind[:1] = True
    stands, unknown = np.zeros((16, 10), bool), np.zeros((16, 10), bool)
    stands[:11, :6], unknown[:15, 6:] = True, True
    assert wall_m(stands, unknown, distance, behind) == pytest.approx(BEHIND_GROUND * distance[11, 0])
    stands[:11, :6] = False
    stands[:1] = True
    assert wall_m(stands, unknown, distance, behind) == pytest.approx(2.0)
    assert wall_m(stands, np.ones_like(unknown), distance, np.zeros_like(behind)) == np.inf


def test_its_top_is_level() -> None:
    picture, z, surface, pose = Desk(box=(0.6, -0.1, 0.1, 0.06), tilt_deg=45.0).seen()
    depth, ground = depth_of(picture, pose)
    top = (surface == 2) & (z * heights(pose) + CAMERA_M > 0.0599)
    assert top.sum() > 500
    assert abs(depth / z - 1)[top].mean() < 0.6 * abs(ground / z - 1)[top].mean()
    height = CAMERA_M + depth * heights(pose)
    assert np.ptp(height[top & (depth < ground)]) < 0.02


def heights(pose: ndarray) -> ndarray:
    """By how much each ray rises, per metre of z."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack(((u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)), -1)
    return rays @ pose[2, :3]


def test_without_vertical_edges_nothing_stands() -> None:
    picture, _, surface, pose = Desk(box=(0.75, 0, 0, 0)).seen()
    depth, ground = depth_of(picture, pose)
    np.testing.assert_allclose(depth[surface < 2], ground[surface < 2], rtol=1e-6)


@pytest.mark.parametrize("tilt_deg", [70.0, 88.0])
def test_from_above_all_is_ground(tilt_deg: float) -> None:
    picture, _, _, pose = Desk(tilt_deg=tilt_deg).seen()
    depth, ground = depth_of(picture, pose)
    np.testing.assert_array_equal(depth, ground)


def test_feet_that_are_hidden_say_nothing() -> None:
    picture, _, surface, pose = Desk().seen()
    box = surface == 2
    low = np.flatnonzero(box.any(1))[-1]
    hidden = np.zeros_like(box)
    hidden[low - 8 : low + 8] = box.any(0)
    depth, ground = depth_of(picture, pose, hidden)
    above = box & ~hidden
    above[:, np.flatnonzero(box.any(0))[[0, -1]]] = False  # pixels of its outline beside what is hidden
    np.testing.assert_allclose(depth[above], ground[above], rtol=1e-6)


def test_the_empty_picture() -> None:
    rgb = np.full((5, 40, 64, 3), 100, np.uint8)
    hidden = np.zeros((5, 40, 64), bool)
    rgb[0, 10:20, 10:20], hidden[0, 10:20, 10:20] = 255, True  # passes
    rgb[:, 25:30, 40:50], hidden[:, 25:30, 40:50] = 0, True  # is always there
    picture, unknown = empty_picture(rgb, hidden)
    np.testing.assert_allclose(picture, 100, atol=3)
    assert unknown[25:30, 40:50].all()
    assert not unknown[:20].any()


@pytest.mark.parametrize("tilt_deg", [20.0, 45.0])
def test_vertical_edges_are_those_of_the_box(tilt_deg: float) -> None:
    picture, _, surface, pose = Desk(tilt_deg=tilt_deg).seen()
    upright = Upright.before(pose[2, :3], np.zeros((1, 1, 3)), CAMERA_M)
    edges = vertical_edges(picture, K, upright.down)
    assert len(edges) >= 2
    near = [surface[edge.rows, np.clip(edge.columns + shift, 0, WIDTH - 1)] == 2 for edge in edges for shift in (-2, 2)]
    assert all(left.mean() > 0.5 or right.mean() > 0.5 for left, right in zip(near[::2], near[1::2], strict=True))


def test_a_camera_that_leans_to_the_side() -> None:
    rays = np.ones((1, 1, 3))
    up = np.array([np.sin(0.5), -np.cos(0.5), 0.0])
    assert not Upright.before(up, rays, 0.4).usable
    assert Upright.before(np.array([0.0, -1.0, 0.0]), rays, 0.4).usable


def test_the_more_stands_the_less_is_sure() -> None:
    ground = torch.ones(10, 10)
    ground[:2] = 2.0
    standing = ground.clone()
    standing[2:5] = 0.5
    assert still_error(ground, ground) == pytest.approx(0.2 * 0.11 + 0.8 * 0.02)
    assert still_error(standing, ground) == pytest.approx(0.5 * 0.11 + 0.5 * 0.02)
