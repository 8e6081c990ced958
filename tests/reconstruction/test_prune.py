"""Moving Gaussians of a colour that the video does not show where they are to be seen are taken out."""

import dataclasses

import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.reconstruction.background import background_gaussians, pixel_gaussians
from lerobot_msdyn.reconstruction.prune import without_contradicted
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import concatenate, rgb_to_sh
from lerobot_msdyn.scene.shading import no_shading

WIDTH, HEIGHT, FRAMES = 32, 24, 6
SQUARE = slice(8, 16)  # px, rows and columns
RED = torch.tensor([200, 40, 40], dtype=torch.uint8)


@pytest.fixture
def square() -> tuple[DynamicScene, View]:
    """A red square that rests before a grey wall, all of it in the moving set."""
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    wall, far = torch.full((HEIGHT, WIDTH, 3), 120, dtype=torch.uint8), torch.full((HEIGHT, WIDTH), 1.0)
    rgb, depth = wall.clone(), far.clone()
    rgb[SQUARE, SQUARE], depth[SQUARE, SQUARE] = RED, 0.8
    static = background_gaussians(wall, far, camera, WIDTH * HEIGHT)
    moving = pixel_gaussians(rgb, depth, camera, 0)[0].select((depth < 0.9).reshape(-1))
    rows = torch.zeros(len(moving), 1)
    level = identity_level(torch.zeros(1, 3), FRAMES)
    scene = DynamicScene(static, moving, (level,), (rows.long(),), (rows,), FRAMES)
    return scene, View(rgb.expand(FRAMES, -1, -1, -1).clone(), camera)


def painted(scene: DynamicScene, which: torch.Tensor) -> DynamicScene:
    """The same with some of the moving set in blue."""
    sh = scene.moving.sh.clone()
    sh[which] = rgb_to_sh(torch.tensor([[0.1, 0.1, 0.9]]))
    return dataclasses.replace(scene, moving=dataclasses.replace(scene.moving, sh=sh))


def test_what_the_video_shows_stays(square: tuple[DynamicScene, View]) -> None:
    scene, view = square
    assert len(without_contradicted(scene, view).moving) == len(scene.moving)


def test_specks_of_another_colour_go(square: tuple[DynamicScene, View]) -> None:
    scene, view = square
    specks = torch.tensor([18, 27])
    pruned = without_contradicted(painted(scene, specks), view)
    kept = torch.ones(len(scene.moving), dtype=torch.bool).index_fill_(0, specks, False)
    torch.testing.assert_close(pruned.moving.means, scene.moving.means[kept])
    assert len(pruned.indices[0]) == len(pruned.logits[0]) == len(pruned.moving)


def test_a_colour_that_leaves_the_picture_right_is_no_reason(square: tuple[DynamicScene, View]) -> None:
    scene, view = square
    faint = torch.tensor([18, 27])
    scene = painted(scene, faint)
    scene.moving.opacity_logits[faint] = -3.0
    more = pixel_gaussians(view.rgb[0], torch.full((HEIGHT, WIDTH), 0.8), view.camera, 0)[0]
    beside = more.select((view.rgb[0] == RED).all(-1).reshape(-1))
    moving = concatenate([scene.moving, beside])
    rows = torch.zeros(len(moving), 1)
    scene = dataclasses.replace(scene, moving=moving, indices=(rows.long(),), logits=(rows,))
    assert len(without_contradicted(scene, view).moving) == len(moving)


def test_a_colour_that_is_wrong_for_a_short_time_is_no_reason(square: tuple[DynamicScene, View]) -> None:
    scene, view = square
    view.rgb[:2, SQUARE, SQUARE] = torch.tensor([25, 25, 230], dtype=torch.uint8)
    assert len(without_contradicted(scene, view).moving) == len(scene.moving)
    view.rgb[:3, SQUARE, SQUARE] = torch.tensor([25, 25, 230], dtype=torch.uint8)
    assert len(without_contradicted(scene, view).moving) < len(scene.moving)


def test_brightness_over_time_counts(square: tuple[DynamicScene, View]) -> None:
    scene, view = square
    shading = no_shading(len(scene.static), len(scene.moving), FRAMES)
    shading.moving[:] = 255  # twice as bright, at all times
    pruned = without_contradicted(dataclasses.replace(scene, shading=shading), view)
    assert pruned.shading is not None
    assert len(pruned.moving) == pruned.shading.moving.shape[1] == 0


def test_what_is_hidden_or_outside_is_not_judged(square: tuple[DynamicScene, View]) -> None:
    scene, view = square
    blue = painted(scene, torch.arange(len(scene.moving)))
    behind = dataclasses.replace(blue, moving=dataclasses.replace(blue.moving, means=2 * blue.moving.means))
    assert len(without_contradicted(behind, view).moving) == len(scene.moving)


def test_nothing_moves(square: tuple[DynamicScene, View]) -> None:
    still = square[0].still()
    assert without_contradicted(still, square[1]) is still
