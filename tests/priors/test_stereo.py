"""Depth from a rectified pair: exact scenes, cameras side by side and above each other."""

import numpy as np
import pytest
from rig import moved

from lerobot_msdyn.priors.depth.stereo import RectifiedPair
from lerobot_msdyn.synthetic import make_scene


@pytest.mark.parametrize(
    ("shift", "turn_deg"),
    [((0.06, 0, 0), 0.0), ((-0.06, 0, 0), 0.0), ((0, 0.06, 0), 0.0), ((0, -0.06, 0), 0.0), ((0.06, 0.01, 0.01), -4.0)],
    ids=["right", "left", "below", "above", "turned"],
)
def test_depth_is_that_of_the_scene(shift: tuple[float, float, float], turn_deg: float) -> None:
    scene = make_scene("push", 0, 2, 320, 240)
    camera = moved(scene.camera, (0, 0, 0)).select([0])
    other = moved(scene.camera, shift, turn_deg).select([0])
    seen, seen_other = scene.render(camera, [0]), scene.render(other, [0])
    depth = RectifiedPair(camera, other).depth(seen.rgb[0].numpy(), seen_other.rgb[0].numpy())
    truth = seen.depth[0].numpy()
    known = (depth > 0) & (truth > 0)
    assert known.mean() > 0.4
    error = np.abs(depth[known] / truth[known] - 1)
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.9) < 0.1
