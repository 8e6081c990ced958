"""Depth of a clip with the help of other cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rig import moved

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors.depth.multiview import multiview_depth, usable_partners, why_no_partner
from lerobot_msdyn.synthetic import make_scene


def clip(scene, shift: tuple[float, float, float], turn_deg: float) -> View:
    camera = moved(scene.camera, shift, turn_deg)
    return View(scene.render(camera).rgb, camera)


@pytest.mark.parametrize(("shift", "turn_deg"), [((0.06, 0, 0), 0.0), ((0.2, 0, 0), -18.0)], ids=["stereo", "features"])
def test_depth_of_a_clip(shift: tuple[float, float, float], turn_deg: float) -> None:
    scene = make_scene("push", 0, 4, 320, 240)
    view, other = clip(scene, (0, 0, 0), 0.0), clip(scene, shift, turn_deg)
    truth = scene.render(view.camera)
    partners = usable_partners(view, [other])
    assert len(partners) == 1
    depth = multiview_depth(view, partners, truth.instances)
    known = (depth > 0) & (truth.depth > 0)
    assert known.float().mean() > 0.4
    error = (depth / truth.depth - 1).abs()[known]
    assert error.median() < 0.05


def test_only_calibrated_cameras_at_another_place_that_look_alike_count() -> None:
    scene = make_scene("push", 0, 2, 64, 48)
    view = View(torch.zeros(2, 48, 64, 3, dtype=torch.uint8), moved(scene.camera, (0, 0, 0)))
    near, far = (replace(view, camera=moved(scene.camera, (0.1, 0, 0), turn)) for turn in (0.0, 30.0))
    away = replace(view, camera=moved(scene.camera, (0.1, 0, 0), 90.0))
    assumed = replace(view, camera=replace(near.camera, origin="assumed"))
    assert usable_partners(view, [far, away, view, assumed, near]) == [near, far]
    assert usable_partners(assumed, [near]) == []
    assert why_no_partner(view, []) == "no other camera of the episode is read with this one"
    assert why_no_partner(assumed, [near]) == "this camera is not calibrated"
    assert why_no_partner(view, [assumed]) == "no other camera is calibrated"
    assert why_no_partner(view, [view]) == "the other calibrated cameras stand at the same place"
    assert "nearest other calibrated camera looks 90 degrees elsewhere" in why_no_partner(view, [away, assumed])


def test_cameras_that_see_different_things_are_refused() -> None:
    scene = make_scene("push", 0, 2, 64, 48)
    noise = np.random.default_rng(0).integers(0, 255, (2, 2, 48, 64, 3)).astype(np.uint8)
    view = View(torch.from_numpy(noise[0]), moved(scene.camera, (0, 0, 0)))
    other = View(torch.from_numpy(noise[1]), moved(scene.camera, (0.3, 0, 0), -30.0))
    with pytest.raises(PriorError, match="features of the background were found in other cameras"):
        multiview_depth(view, [other], torch.zeros(2, 48, 64, dtype=torch.uint8))
