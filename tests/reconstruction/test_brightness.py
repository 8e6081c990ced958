"""Shadows, exposure and shading are measured where they are, and carried where they cannot be seen."""

import dataclasses

import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.reconstruction.background import background_gaussians, pixel_gaussians
from lerobot_msdyn.reconstruction.brightness import moving_gain, static_shading
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.shading import decode_gain

WIDTH, HEIGHT, FRAMES = 40, 30, 6
INSIDE = (slice(8, 22), slice(12, 28))
WALL = torch.full((HEIGHT, WIDTH, 3), 120, dtype=torch.uint8)


@pytest.fixture
def scene() -> tuple[DynamicScene, View, Priors]:
    """A grey wall at 1 m, and before it a square at 0.8 m that does not really move."""
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    rgb = WALL.expand(FRAMES, -1, -1, -1).clone()
    depth, instances = torch.ones(FRAMES, HEIGHT, WIDTH), torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    depth[:, *INSIDE], instances[:, *INSIDE] = 0.8, 1
    none = PointTracks(
        torch.zeros(0, FRAMES, 2), torch.zeros(0, FRAMES).bool(), torch.zeros(0, FRAMES), torch.zeros(0).long()
    )
    static = background_gaussians(WALL, torch.ones(HEIGHT, WIDTH), camera, 10_000)
    moving = pixel_gaussians(WALL, depth[0], camera, 0)[0].select((instances[0] > 0).reshape(-1))
    level = identity_level(torch.zeros(1, 3), FRAMES)
    rows = torch.zeros(len(moving), 1)
    drawn = DynamicScene(static, moving, (level,), (rows.long(),), (rows,), FRAMES)
    return drawn, View(rgb, camera), Priors(depth, instances, none, DepthTraits(metric=True))


def test_a_change_of_exposure_is_found_also_behind_what_moves(scene: tuple[DynamicScene, View, Priors]) -> None:
    drawn, view, priors = scene
    rgb = view.rgb.clone()
    rgb[3:] = 90
    rgb[:, *INSIDE] = 255  # what moves tells nothing about the wall
    shading = static_shading(drawn, dataclasses.replace(view, rgb=rgb), priors, WALL)
    gain = shading.static_gain(torch.tensor([0, 5]))
    torch.testing.assert_close(gain[0], torch.ones(WIDTH * HEIGHT), atol=0.01, rtol=0)
    torch.testing.assert_close(gain[1], torch.full((WIDTH * HEIGHT,), 0.75), atol=0.02, rtol=0)


def test_a_shadow_stays_where_it_falls(scene: tuple[DynamicScene, View, Priors]) -> None:
    drawn, view, priors = scene
    rgb = view.rgb.clone()
    rgb[:, :, :6] = 80
    gain = static_shading(drawn, dataclasses.replace(view, rgb=rgb), priors, WALL).static_gain(torch.tensor([2]))
    image = gain.reshape(HEIGHT, WIDTH)
    assert image[:, 1].max() < 0.75
    assert image[:, 20:].min() > 0.98


def test_before_a_moving_camera_gains_stay_with_the_surface(scene: tuple[DynamicScene, View, Priors]) -> None:
    drawn, view, priors = scene
    focal = float(view.camera.intrinsics[0, 0, 0])
    poses, rgb = view.camera.world_from_camera.clone(), view.rgb.clone()
    for t in range(FRAMES):  # by a column to the right per frame; the shadow goes to the left in the picture
        poses[t, 0, 3] += t / focal
        rgb[t, :, : 10 - t] = 60
    view = dataclasses.replace(view, rgb=rgb, camera=dataclasses.replace(view.camera, world_from_camera=poses))
    still = dataclasses.replace(priors, instances=torch.zeros_like(priors.instances))
    shading = static_shading(drawn, view, still, WALL)
    gain = shading.static_gain(torch.arange(1, 3)).reshape(2, HEIGHT, WIDTH)
    torch.testing.assert_close(gain[:, 5:25, 4:7], torch.full((2, 20, 3), 0.52), atol=0.06, rtol=0)
    torch.testing.assert_close(gain[:, 5:25, 14:34], torch.ones(2, 20, 20), atol=0.04, rtol=0)


def test_brightness_of_what_moves_is_followed_and_bridged(scene: tuple[DynamicScene, View, Priors]) -> None:
    drawn, view, priors = scene
    rgb, instances = view.rgb.clone(), priors.instances.clone()
    rgb[:, *INSIDE] = 90
    instances[3:] = 0  # afterwards it is not seen
    gain = decode_gain(
        moving_gain(drawn, dataclasses.replace(view, rgb=rgb), dataclasses.replace(priors, instances=instances))
    )
    assert gain.shape == (FRAMES, len(drawn.moving))
    inner = gain[:, gain[0] < 0.9]  # Gaussians at the very border show the wall too
    assert inner.shape[1] > 0.7 * len(drawn.moving)
    torch.testing.assert_close(inner, torch.full_like(inner, 0.76), atol=0.05, rtol=0)


def test_gaussians_that_are_never_seen_keep_their_brightness(scene: tuple[DynamicScene, View, Priors]) -> None:
    drawn, view, priors = scene
    nothing = dataclasses.replace(priors, instances=torch.zeros_like(priors.instances))
    assert (decode_gain(moving_gain(drawn, view, nothing)) == 1).all()
