"""Depth by the way of a camera that moves: what stands still is triangulated, a network's depth comes to its unit."""

from dataclasses import replace

import pytest
import torch
from walking import walk_along

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.priors import estimate_priors
from lerobot_msdyn.priors.cache import open_cache
from lerobot_msdyn.priors.depth.metres import in_metres
from lerobot_msdyn.priors.depth.providers.parallax import Parallax
from lerobot_msdyn.priors.registry import Unusable
from lerobot_msdyn.priors.request import Request
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.viewpoints import walking_camera

Walked = tuple[View, Priors]


@pytest.fixture(scope="module")
def walked() -> Walked:
    """A walk along an arc of 20 degrees, with true depth and masks beside."""
    _, view, priors = walk_along((-25.0, -5.0))
    return view, priors


def request_of(view: View, camera: CameraTrack | None = None) -> Request:
    view = view if camera is None else replace(view, camera=camera)
    return Request(view, PriorsConfig(), CameraConfig(), open_cache("off", view.rgb))


def off(found: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    known = found > 0
    return (found[known] / true[known] - 1).abs()


def test_corners_that_go_by_tell_how_far_they_are(walked: Walked) -> None:
    view, priors = walked
    depth = Parallax().reference(request_of(view), priors.instances).value
    assert depth.traits.metric
    assert (depth.z > 0).sum() > 300
    assert (depth.z > 0)[priors.instances > 0].sum() < 0.05 * (depth.z > 0).sum()
    assert off(depth.z, priors.depth).median() < 0.1  # 96 px wide; 0.012 at 320


def test_between_them_depth_is_smooth_and_what_moves_stands_on_it(walked: Walked) -> None:
    view, priors = walked
    depth = Parallax().estimate(request_of(view), priors.instances).value
    assert (depth.z > 0).all()
    assert not depth.traits.assumed
    still = priors.instances == 0
    assert off(depth.z[still], priors.depth[still]).median() < 0.1
    assert off(depth.z[~still], priors.depth[~still]).median() < 0.25
    turned = replace(view.camera, world_from_camera=view.camera.world_from_camera[:1].repeat(len(view), 1, 1))
    with pytest.raises(Unusable, match="no pose per frame"):
        Parallax().usable(request_of(view, turned))


def test_a_camera_that_only_turns_tells_nothing(walked: Walked) -> None:
    view, priors = walked
    poses = view.camera.world_from_camera.clone()
    poses[:, :3, 3] = poses[0, :3, 3]
    turned = replace(view.camera, world_from_camera=poses)
    with pytest.raises(PriorError, match="expected 100 or more: it goes too little to the side"):
        Parallax().estimate(request_of(view, turned), priors.instances)


def test_depth_without_a_scale_comes_to_the_unit_of_the_poses(walked: Walked) -> None:
    view, priors = walked
    for kind, values in (("affine_disparity", 0.3 / priors.depth + 0.2), ("scale", 3 * priors.depth)):
        found = in_metres(request_of(view), priors.instances, values, kind, trusted=False)
        assert found.how.endswith("to parallax")
        assert found.value.traits.metric
        assert off(found.value.z, priors.depth).median() < 0.03


def test_metres_of_a_network_are_corrected_by_the_poses(walked: Walked) -> None:
    view, priors = walked
    found = in_metres(request_of(view), priors.instances, 1.4 * priors.depth, "metric", trusted=False)
    assert off(found.value.z, priors.depth).median() < 0.03


def test_what_a_network_is_off_by_smoothly_is_told_by_the_corners() -> None:
    frames, width, height = 8, 320, 240
    camera = walking_camera(frames, width, height, (-25.0, -5.0))
    seen = make_scene("push", 0, frames, width, height).render(camera)
    view, still = View(seen.rgb, camera), seen.instances == 0
    for slope, at_most in ((0.0, 0.01), (0.08, 0.03)):
        factor = torch.linspace(-slope, slope, width).exp()  # 0.04 from the truth on average
        found = in_metres(request_of(view), seen.instances, factor * seen.depth, "scale", trusted=False).value.z
        assert off(found[still], seen.depth[still]).mean() < at_most


def test_poses_from_structure_from_motion_get_a_plausible_unit(walked: Walked) -> None:
    view, priors = walked
    poses = view.camera.world_from_camera.clone()
    poses[:, :3, 3] *= 0.01
    unscaled = replace(view.camera, world_from_camera=poses, origin="sfm", world="")
    depth = Parallax().estimate(request_of(view, unscaled), priors.instances).value
    assert not depth.traits.metric
    assert 0.3 < depth.z.median() < 3  # m
    ratio = depth.z[priors.instances == 0] / priors.depth[priors.instances == 0]
    assert (ratio / ratio.median() - 1).abs().median() < 0.1


def test_auto_takes_it_where_poses_are_all_there_is(walked: Walked) -> None:
    view, _ = walked
    alone = replace(view, depth=None)
    priors = estimate_priors(alone, PriorsConfig(cache="off"), CameraConfig())
    assert priors.provenance["depth"]["provider"] == "parallax"
    fixed = replace(alone, camera=replace(view.camera, world_from_camera=torch.eye(4).repeat(len(view), 1, 1)))
    assert estimate_priors(fixed, PriorsConfig(cache="off"), CameraConfig()).provenance["depth"]["provider"] == "plane"
