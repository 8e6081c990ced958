"""What stands still before a camera that moves: all frames fused, one element per surface."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from walking import FRAMES, HEIGHT, WIDTH, walk

from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.reconstruction.background import empty_scene
from lerobot_msdyn.reconstruction.key_views import KeyView, key_views, static_gaussians
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import render_scene
from lerobot_msdyn.synthetic.nvs import covisibility
from lerobot_msdyn.synthetic.scene import SyntheticScene
from lerobot_msdyn.synthetic.viewpoints import heldout_cameras


@pytest.fixture(scope="module")
def walked() -> tuple[SyntheticScene, View, Priors]:
    return walk()


@pytest.fixture(scope="module")
def keys(walked: tuple[SyntheticScene, View, Priors]) -> tuple[KeyView, ...]:
    return key_views(*walked[1:])


def test_a_fixed_camera_has_one_view_of_what_is_always_there(walked: tuple[SyntheticScene, View, Priors]) -> None:
    scene, _, priors = walked
    seen = scene.render(scene.camera)
    priors = replace(priors, depth=seen.depth, instances=seen.instances)
    (key,) = key_views(View(seen.rgb, scene.camera), priors)
    expected = empty_scene(seen.rgb, seen.depth, seen.instances)
    assert torch.equal(key.empty.rgb, expected.rgb)
    assert torch.equal(key.empty.depth, expected.depth)
    assert key.new.all()
    assert len(static_gaussians([key], 100_000)) == WIDTH * HEIGHT


def test_what_hides_the_desk_is_looked_past(
    walked: tuple[SyntheticScene, View, Priors], keys: tuple[KeyView, ...]
) -> None:
    scene, view, _ = walked
    key = keys[0]
    frame = int((view.camera.world_from_camera == key.camera.world_from_camera).all((1, 2)).nonzero()[0])
    surface = scene.surface(key.camera, [frame])
    hidden = torch.from_numpy(scene.instance_of_primitive[surface.primitive[0]] > 0)
    behind = hidden & (key.empty.seen > 0)
    assert behind.float().mean() > 0.02
    assert (key.empty.depth[behind] > 1.01 * torch.from_numpy(surface.depth[0])[behind]).float().mean() > 0.9
    free = ~hidden & (key.empty.seen > 0)
    off = (key.empty.depth / torch.from_numpy(surface.depth[0]) - 1).abs() > 0.02
    assert off[free].float().mean() < 0.005  # single pixels beside edges


def test_later_views_add_only_what_earlier_ones_do_not_show(keys: tuple[KeyView, ...]) -> None:
    assert 1 < len(keys) < FRAMES
    assert keys[0].new.all()
    added = sum(int(key.new.sum()) for key in keys[1:])
    assert 0 < added < 0.6 * WIDTH * HEIGHT


def test_a_held_out_camera_sees_the_desk_as_it_is(
    walked: tuple[SyntheticScene, View, Priors], keys: tuple[KeyView, ...]
) -> None:
    scene, view, priors = walked
    static = static_gaussians(keys, 100_000)
    drawn = DynamicScene(static, static.select(slice(0)), (), (), (), FRAMES)
    recorded = replace(scene, cameras={**scene.cameras, "front": view.camera})
    errors = []
    for name, camera in heldout_cameras(1, WIDTH, HEIGHT).items():
        if name in ("az+10", "el-08", "tx+05"):
            truth = scene.render(camera, [6])
            covered = torch.from_numpy(covisibility(recorded, priors.depth.numpy(), camera, [6])[0] > 0)
            still = covered & (truth.instances[0] == 0)
            shown = render_scene(drawn, camera, torch.tensor([6])).rgb[0].clamp(0, 1)
            errors.append(float((shown - truth.rgb[0] / 255).square().mean(-1)[still].mean()))
    assert -10 * np.log10(np.mean(errors)) > 20  # dB, before any fit, at 96 px


def test_without_any_depth_there_is_a_guess(walked: tuple[SyntheticScene, View, Priors]) -> None:
    _, view, priors = walked
    (key,) = key_views(view, replace(priors, depth=torch.zeros_like(priors.depth)))
    assert key.empty.seen.max() == 0
    assert torch.isfinite(static_gaussians([key], 100).means).all()


def test_depth_that_few_frames_have_is_no_surface(walked: tuple[SyntheticScene, View, Priors]) -> None:
    _, view, priors = walked
    depth = priors.depth.clone()
    depth[::6, 20:40, 30:60] = 0.3  # m: floats far before the desk
    for key in key_views(view, replace(priors, depth=depth)):
        assert (key.empty.depth[key.empty.seen > 0] > 0.35).all()
