"""A picture seen from elsewhere by its depth."""

import numpy as np
import torch

from lerobot_msdyn.evaluate.warp import warped
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.viewpoints import heldout_cameras


def test_the_same_camera_shows_the_same_picture() -> None:
    scene = make_scene("push", 0, 2, 48, 36)
    seen = scene.render(scene.camera)
    camera = scene.camera.select([0])
    through = warped(seen.rgb[0].numpy(), seen.depth[0].numpy(), camera, camera)
    assert np.abs(through.astype(int) - seen.rgb[0].numpy()).max() <= 1


def test_a_warp_is_closer_than_no_change_of_view() -> None:
    scene = make_scene("push", 0, 2, 96, 72)
    seen = scene.render(scene.camera)
    target = heldout_cameras(1, 96, 72)["az+10"]
    true = scene.render(target, [0]).rgb[0].numpy().astype(float)
    through = warped(seen.rgb[0].numpy(), seen.depth[0].numpy(), scene.camera.select([0]), target)
    assert through.shape == true.shape
    assert np.abs(through - true).mean() < 0.7 * np.abs(seen.rgb[0].numpy() - true).mean()
    unknown = warped(seen.rgb[0].numpy(), torch.zeros(72, 96).numpy(), scene.camera.select([0]), target)
    assert (unknown == 0).all()
