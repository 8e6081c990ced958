"""The whole flow on a GPU and on the CPU ends at the same quality; skipped without a GPU."""

from pathlib import Path

import pytest
import torch

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.core.config import Device, Recipe
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.reconstruction.account import decibels
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.render.availability import cuda_problem
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.views.pictures import for_many_views, new_pictures

pytestmark = [pytest.mark.gpu, pytest.mark.slow]

ROUTES: tuple[Device, Device] = ("cpu", "cuda")
MAX_DIFFERENCE_DB = 0.2


@pytest.fixture(autouse=True)
def _gpu() -> None:
    if cuda_problem():
        pytest.skip(cuda_problem())


def test_both_routes_reach_the_same_held_out_quality() -> None:
    video = make_scene("push", 0, 40, 160, 120)
    seen = video.render(video.camera)
    held_out_db, pictures = {}, {}
    for device in ROUTES:
        recipe = Recipe(device=device)
        recipe.fit.steps, recipe.priors.cache = 200, "off"
        scene = reconstruct(View(seen.rgb, video.camera, seen.depth), recipe)
        assert scene.windows[0].scene.device.type == "cpu"
        held_out_db[device] = decibels(float(scene.windows[0].self_check.fitted_error.mean()))
        ready = for_many_views(scene, torch.device(device))
        pictures[device] = next(new_pictures(ready, scene.camera)).rgb.astype(float)
    assert abs(held_out_db["cuda"] - held_out_db["cpu"]) < MAX_DIFFERENCE_DB, held_out_db
    assert abs(pictures["cuda"] - pictures["cpu"]).mean() < 2


def test_the_command_on_a_gpu(desk: Path, tmp_path: Path) -> None:
    flags = {"repo": "local/desk", "root": desk, "new_root": tmp_path / "new", "device": "cuda", "fit.steps": 8}
    flags |= {"variants": 1, "workers": 2, "save_scenes": "true"}
    assert augment.run([f"--{name}={value}" for name, value in flags.items()]) == 0
