"""New cameras keep to what was recorded: shrunk, cropped, or rejected."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.views.new_cameras import SMALLEST, covered_rectangle, largest_factor, new_cameras
from lerobot_msdyn.views.perturbations.poses import Poses
from lerobot_msdyn.views.perturbations.translation import Translation
from lerobot_msdyn.views.pictures import coverages


@pytest.fixture(scope="module")
def scenes() -> dict[str, Reconstruction]:
    scene = make_scene("push", 0, 6, 64, 48)
    seen = scene.render(scene.camera)
    return {"front": reconstruct(View(seen.rgb, scene.camera, seen.depth), recipe())}


def recipe(**changes: Any) -> Recipe:
    found = dataclasses.replace(Recipe(), **changes)
    found.fit.steps = 2
    return found


def test_largest_factor_is_found_by_bisection() -> None:
    assert largest_factor(lambda factor: 0.1 * factor, 0.2) == 1.0
    assert largest_factor(lambda factor: factor, 0.5) == pytest.approx(0.5, abs=0.03)
    assert largest_factor(lambda factor: 1.0, 0.5) is None


def test_a_change_that_shows_too_much_is_shrunk(scenes: dict[str, Reconstruction]) -> None:
    settings = recipe(perturbation=Translation(translation_m=0.6), max_unseen=0.15)
    found = new_cameras(scenes, settings, 0, 0)
    assert not found.rejected
    assert SMALLEST <= found.amounts["front"]["shrunk_to"] < 1
    shares = [coverage.unseen_share for coverage in coverages(scenes["front"], found.cameras["front"])]
    assert 0.05 < max(shares) <= 0.16


def test_what_cannot_be_shrunk_is_rejected(scenes: dict[str, Reconstruction]) -> None:
    back = [*torch.eye(4)[:2].flatten().tolist(), 0.0, 0.0, 1.0, 2.0]  # 2 m along the optical axis
    assert "unseen" in new_cameras(scenes, recipe(max_unseen=0.0, perturbation=Poses(poses=[back])), 0, 0).rejected


def test_a_crop_shows_only_what_was_seen(scenes: dict[str, Reconstruction]) -> None:
    settings = recipe(perturbation=Translation(translation_m=0.1), max_unseen=1.0)
    camera = new_cameras(scenes, settings, 0, 1).cameras["front"]
    cropped = new_cameras(scenes, dataclasses.replace(settings, crop_to_covered=True), 0, 1).cameras["front"]
    assert (cropped.width, cropped.height) == (camera.width, camera.height)
    assert float(cropped.intrinsics[0, 0, 0]) > float(camera.intrinsics[0, 0, 0])
    before, after = (next(coverages(scenes["front"], c)).empty.mean() for c in (camera, cropped))
    assert after < 0.02 < before


def test_covered_rectangle() -> None:
    empty = np.zeros((48, 64), bool)
    assert covered_rectangle(empty) == (0, 0, 1)
    empty[:, :16] = True
    left, top, size = covered_rectangle(empty)
    assert left >= 0.25
    assert 0.7 < size <= 0.76
    assert 0 < top < 0.25
    assert covered_rectangle(np.ones((48, 64), bool)) == (0, 0, 1)


def test_a_pose_behind_the_table_is_refused(scenes: dict[str, Reconstruction]) -> None:
    ahead = [*torch.eye(4)[:2].flatten().tolist(), 0.0, 0.0, 1.0, -3.0]  # 3 m along the optical axis
    with pytest.raises(ConfigError, match="behind what the recorded camera of episode 0 sees") as caught:
        new_cameras(scenes, recipe(perturbation=Poses(poses=[ahead])), 0, 0)
    assert "\n" not in str(caught.value)


def test_the_same_numbers_give_the_same_cameras(scenes: dict[str, Reconstruction]) -> None:
    first, second = (new_cameras(scenes, recipe(max_unseen=0.1), 2, 1).cameras["front"] for _ in range(2))
    assert torch.equal(first.world_from_camera, second.world_from_camera)
