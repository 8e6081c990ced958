"""The static set: where its Gaussians are, how they lie, and that they draw the picture they were made from."""

import math

import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera
from lerobot_msdyn.core.geometry import project, quaternion_to_matrix, transform_points, unproject_image
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.reconstruction.background import (
    background_gaussians,
    empty_scene,
    fill_depth,
    pixel_gaussians,
    surface_frames,
)
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import render_scene
from lerobot_msdyn.views.offsets import orbit_offset

WIDTH, HEIGHT = 32, 24


@pytest.fixture
def camera() -> CameraTrack:
    return static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), 1, WIDTH, HEIGHT, orbit_offset(30.0, 10.0, 1.0))


def with_steps(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points of an image, and how they change to the right and downwards."""
    dy, dx = torch.gradient(points, dim=(0, 1))
    return points, dx, dy


def slanted_plane(camera: CameraTrack, degrees: float) -> torch.Tensor:
    """Depth of a plane through (0, 0, 1) turned about the camera's x axis."""
    rays = unproject_image(torch.ones(HEIGHT, WIDTH), camera.intrinsics[0])
    normal = torch.tensor([0.0, -math.sin(math.radians(degrees)), -math.cos(math.radians(degrees))])
    return normal[2] / (rays @ normal)


def test_every_pixel_has_its_gaussian_where_its_surface_is(camera: CameraTrack) -> None:
    depth = slanted_plane(camera, 30)
    gaussians, xy = pixel_gaussians(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8), depth, camera, 0)
    seen, z = project(transform_points(camera.camera_from_world[0], gaussians.means), camera.intrinsics[0])
    torch.testing.assert_close(seen, xy, atol=1e-3, rtol=0)
    torch.testing.assert_close(z, depth.reshape(-1))


def test_gaussians_lie_flat_on_the_surface(camera: CameraTrack) -> None:
    depth = slanted_plane(camera, 40)
    rotation, _ = surface_frames(*with_steps(unproject_image(depth, camera.intrinsics[0])))
    expected = torch.tensor([0.0, -math.sin(math.radians(40)), -math.cos(math.radians(40))])
    torch.testing.assert_close(rotation[5, 5, :, 2], expected, atol=1e-4, rtol=0)
    gaussians, _ = pixel_gaussians(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8), depth, camera, 0)
    world_normal = quaternion_to_matrix(gaussians.quats)[5 * WIDTH + 5, :, 2]
    torch.testing.assert_close(world_normal, camera.world_from_camera[0, :3, :3] @ expected, atol=1e-4, rtol=0)
    scales = gaussians.log_scales.exp()
    assert (scales[:, 2] < scales[:, :2].min(dim=1).values).all()


def test_rotations_are_proper_everywhere(camera: CameraTrack) -> None:
    depth = slanted_plane(camera, 20)
    depth[10:, 16:] *= 3  # a depth edge
    rotation, cosine = surface_frames(*with_steps(unproject_image(depth, camera.intrinsics[0])))
    identity = torch.eye(3).expand_as(rotation)
    torch.testing.assert_close(rotation.transpose(-1, -2) @ rotation, identity, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(HEIGHT, WIDTH))
    assert (cosine > 0).all()


def test_the_recorded_camera_sees_the_picture_again(camera: CameraTrack) -> None:
    x = torch.linspace(40, 200, WIDTH)
    median = x[None, :, None].expand(HEIGHT, -1, 3).round().to(torch.uint8)
    static = background_gaussians(median, slanted_plane(camera, 30), camera, 10_000)
    empty = static.select(torch.zeros(0, dtype=torch.long))
    scene = DynamicScene(
        static,
        empty,
        (identity_level(torch.zeros(1, 3), 1),),
        (torch.zeros(0, 1, dtype=torch.long),),
        (torch.zeros(0, 1),),
        1,
    )
    drawn = render_scene(scene, camera, torch.tensor([0]))
    inner = (0, slice(3, -3), slice(3, -3))
    assert (drawn.alpha[inner] > 0.95).all()
    assert (drawn.rgb[inner] - median[inner[1:]].float() / 255).abs().mean() < 0.03


def test_fewer_gaussians_than_pixels(camera: CameraTrack) -> None:
    median = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    static = background_gaussians(median, slanted_plane(camera, 30), camera, 200)
    assert len(static) == WIDTH * HEIGHT // 4


def test_unknown_depth_is_taken_from_the_nearest_pixel() -> None:
    depth = torch.zeros(3, 4)
    depth[1, 0], depth[1, 3] = 2.0, 5.0
    assert fill_depth(depth)[1].tolist() == [2.0, 2.0, 5.0, 5.0]
    assert (fill_depth(torch.zeros(3, 4)) == 1).all()


def test_the_empty_scene_is_what_shows_when_nothing_is_in_front() -> None:
    frames = 20
    rgb = torch.full((frames, HEIGHT, WIDTH, 3), 90, dtype=torch.uint8)
    depth, instances = torch.ones(frames, HEIGHT, WIDTH), torch.zeros(frames, HEIGHT, WIDTH, dtype=torch.uint8)
    for frame in range(1, frames):  # something at 0.5 m leaves only at the first frame
        rgb[frame, 8:16, 8:16], depth[frame, 8:16, 8:16], instances[frame, 8:16, 8:16] = 200, 0.5, 1
    rgb[1:, 7, 8:16] = 140  # and bleeds beyond its mask
    found = empty_scene(rgb, depth, instances)
    assert (found.rgb == 90).all()
    assert (found.depth == 1).all()
    assert int(found.seen[12, 12]) == 1
    assert int(found.seen[0, 0]) == frames


def test_what_was_never_seen_is_continued_from_around_it() -> None:
    rgb = torch.full((3, HEIGHT, WIDTH, 3), 90, dtype=torch.uint8)
    instances = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8)
    rgb[:, 8:16, 8:16], instances[:, 8:16, 8:16] = 200, 1
    found = empty_scene(rgb, torch.ones(3, HEIGHT, WIDTH), instances)
    assert ((found.rgb.int() - 90).abs() <= 2).all()
    assert (found.seen[8:16, 8:16] == 0).all()
    assert (found.depth[8:16, 8:16] == 0).all()
    everything = empty_scene(rgb, torch.ones(3, HEIGHT, WIDTH), torch.ones_like(instances))
    assert (everything.seen == 0).all()
