"""Scenes: what they hold at a time, saved and loaded."""

import dataclasses
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.motion.field import DeformationField, fit_field
from lerobot_msdyn.motion.model.bases import MotionLevel, level_from_motions
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians, concatenate, gaussians_from_points, isotropic, with_slope
from lerobot_msdyn.scene.shading import encode_gain, no_shading
from lerobot_msdyn.scene.store import load_scene, save_scene


def some_gaussians(count: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return gaussians_from_points(
        torch.randn(count, 3, generator=generator),
        torch.randn(count, 4, generator=generator),
        torch.rand(count, 3, generator=generator) + 0.1,
        torch.rand(count, 3, generator=generator),
        0.7,
    )


def scene_with_two_parts() -> DynamicScene:
    """The second part shifts by 1 m along x at frame 1 and turns a quarter about z at frame 2."""
    motions = torch.eye(4).repeat(2, 3, 1, 1)
    motions[1, 1, 0, 3] = 1.0
    motions[1, 2] = se3(axis_angle_to_matrix(torch.tensor([0.0, 0.0, torch.pi / 2])), torch.zeros(3))
    level = level_from_motions(motions, torch.zeros(2, 3))
    part = torch.tensor([0, 1, 1])
    return DynamicScene(
        some_gaussians(2), some_gaussians(3, 1), (level,), (part[:, None],), (torch.zeros(3, 1),), frames=3
    )


def test_points_become_gaussians() -> None:
    gaussians = gaussians_from_points(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.02),
        torch.tensor([[0.1, 0.5, 0.9]]),
        0.7,
    )
    torch.testing.assert_close(gaussians.log_scales.exp(), torch.full((1, 3), 0.02))
    torch.testing.assert_close(gaussians.opacity_logits.sigmoid(), torch.tensor([0.7]))
    torch.testing.assert_close(gaussians.rgb, torch.tensor([[0.1, 0.5, 0.9]]))


def test_static_stays_and_moving_follows_its_part() -> None:
    scene = scene_with_two_parts()
    snapshot = scene.at(torch.tensor([0, 1, 2]))
    still, moving = snapshot.means[:, :2], snapshot.means[:, 2:]
    torch.testing.assert_close(still, scene.static.means.expand(3, -1, -1))
    torch.testing.assert_close(moving[:, 0], scene.moving.means[0].expand(3, -1))
    torch.testing.assert_close(moving[0], scene.moving.means)
    torch.testing.assert_close(moving[1, 1:], scene.moving.means[1:] + torch.tensor([1.0, 0, 0]))
    x, y, z = scene.moving.means[1:].unbind(-1)
    torch.testing.assert_close(moving[2, 1:], torch.stack((-y, x, z), dim=-1), atol=1e-6, rtol=0)
    assert snapshot.moving.tolist() == [0, 0, 1, 1, 1]


def test_select_and_concatenate_undo_each_other() -> None:
    gaussians = some_gaussians(5)
    parts = [gaussians.select(torch.tensor([0, 1])), gaussians.select(torch.tensor([2, 3, 4]))]
    torch.testing.assert_close(concatenate(parts).means, gaussians.means)
    torch.testing.assert_close(concatenate(parts).sh, gaussians.sh)


def test_a_saved_scene_comes_back(tmp_path: Path) -> None:
    scene = scene_with_two_parts()
    save_scene(scene, tmp_path / "scene.safetensors")
    again = load_scene(tmp_path / "scene.safetensors")
    frames = torch.arange(3)
    for name in ("means", "quats", "scales", "opacities", "rgb", "moving"):
        assert torch.equal(getattr(scene.at(frames), name), getattr(again.at(frames), name))
    assert again.frames == 3
    assert [path.name for path in tmp_path.iterdir()] == ["scene.safetensors"]


def test_all_kinds_of_levels_come_back(tmp_path: Path) -> None:
    scene = scene_with_two_parts()
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    field = fit_field(points, points[:, None].expand(-1, 3, -1), torch.ones(20, 3), steps=2)
    nothing = torch.zeros(3, 0)
    scene = dataclasses.replace(
        scene,
        levels=(*scene.levels, field),
        indices=(*scene.indices, nothing.long()),
        logits=(*scene.logits, nothing),
        moving=isotropic(scene.moving),
    )
    save_scene(scene, tmp_path / "scene.safetensors")
    again = load_scene(tmp_path / "scene.safetensors")
    assert [type(level) for level in again.levels] == [MotionLevel, DeformationField]
    assert torch.equal(again.at(torch.tensor([1, 2])).means, scene.at(torch.tensor([1, 2])).means)
    assert torch.equal(again.at(torch.tensor([1])).scales, scene.at(torch.tensor([1])).scales)


def test_a_scene_without_some_of_its_arrays_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    header = '{"schema": 3, "near": 0.01, "levels": ["bases"], "frames": 3}'
    save_file({"static.means": torch.zeros(1, 3)}, path, metadata={"lerobot_msdyn": header})
    with pytest.raises(MsdynError, match=r"not a readable scene file .*is missing"):
        load_scene(path)


def test_shading_is_saved_too(tmp_path: Path) -> None:
    scene = scene_with_two_parts()
    gains = torch.tensor([[1.0, 1.0, 1.0], [0.5, 1.0, 2.0], [1.0, 1.0, 1.0]])
    shading = dataclasses.replace(no_shading(2, 3, 3), moving=encode_gain(gains))
    save_scene(dataclasses.replace(scene, shading=shading), tmp_path / "scene.safetensors")
    again = load_scene(tmp_path / "scene.safetensors").at(torch.tensor([1]))
    torch.testing.assert_close(again.rgb[0, :2], scene.static.rgb)
    torch.testing.assert_close(again.rgb[0, 2:], scene.moving.rgb * gains[1, :, None], atol=0.01, rtol=0)


def test_colours_of_what_moves_depend_on_the_side_from_which_it_is_seen() -> None:
    scene = scene_with_two_parts()
    sloped = with_slope(scene.moving)
    sloped.means[:] = 0
    sloped.sh[:, 0] = 0
    sloped.sh[:, 3] = -1  # brighter the more one looks along the canonical x
    scene = dataclasses.replace(scene, moving=sloped)
    along_x = scene.at(torch.tensor([0, 2]), torch.tensor([[-5.0, 0, 0]] * 2)).rgb[:, 2:, 0]
    # At frame 2 the second part has turned a quarter about z: one looks along its own -y.
    expected = torch.tensor([[0.5 + 0.4886025] * 3, [0.5 + 0.4886025, 0.5, 0.5]])
    torch.testing.assert_close(along_x, expected)
    from_nowhere = scene.at(torch.tensor([0, 2])).rgb[:, 2:]
    torch.testing.assert_close(from_nowhere, torch.full_like(from_nowhere, 0.5))


def test_what_is_no_scene_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    with pytest.raises(MsdynError, match="not a readable scene file"):
        load_scene(path)
    path.write_bytes(b"nothing")
    with pytest.raises(MsdynError, match="not a readable scene file"):
        load_scene(path)
    save_file({"a": torch.zeros(1)}, path, metadata={"lerobot_msdyn": '{"schema": 99}'})
    with pytest.raises(MsdynError, match="scene schema is 99; expected 3"):
        load_scene(path)
