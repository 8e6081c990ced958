"""The vertical is the table's normal, where a table is seen."""

import math

import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov
from lerobot_msdyn.priors.depth.table_plane import table_plane
from lerobot_msdyn.reconstruction.upright import up_of
from lerobot_msdyn.synthetic import make_scene

WIDTH, HEIGHT = 80, 60


def angle_deg(a: torch.Tensor, b: torch.Tensor) -> float:
    return math.degrees(math.acos(min(1.0, float(a @ b))))


@pytest.mark.parametrize("camera", ["front", "side"])
def test_the_vertical_of_a_desk(camera: str) -> None:
    scene = make_scene("push", 3, 2, WIDTH, HEIGHT)
    track = scene.cameras[camera] if camera != "front" else scene.camera
    depth = scene.render(track).depth[0]
    truth = track.world_from_camera[0, :3, :3].T @ torch.tensor([0.0, 0.0, 1.0])
    noisy = depth * (1 + 0.003 * torch.randn(depth.shape, generator=torch.Generator().manual_seed(0)))
    for seen in (depth, noisy, torch.where(torch.rand(depth.shape) < 0.3, 0.0, depth)):
        assert angle_deg(torch.tensor(up_of(seen, track.intrinsics[0], 10.0)), truth) < 2.0


@pytest.mark.parametrize("tilt_deg", [15.0, 35.0, 70.0])
def test_an_assumed_table_is_as_assumed(tilt_deg: float) -> None:
    intrinsics = intrinsics_from_fov(WIDTH, HEIGHT, 60.0)
    depth = table_plane(WIDTH, HEIGHT, intrinsics, 0.5, tilt_deg)
    truth = torch.tensor([0.0, -math.cos(math.radians(tilt_deg)), -math.sin(math.radians(tilt_deg))])
    assert angle_deg(torch.tensor(up_of(depth, intrinsics, 10.0)), truth) < 0.5


def test_a_table_from_above() -> None:
    up = up_of(torch.full((HEIGHT, WIDTH), 1.0), intrinsics_from_fov(WIDTH, HEIGHT, 60.0), 30.0)
    assert up == pytest.approx((0.0, 0.0, -1.0), abs=1e-3)


@pytest.mark.parametrize("depth", [torch.zeros(HEIGHT, WIDTH), None])
def test_without_a_table_the_tilt_is_assumed(depth: torch.Tensor | None) -> None:
    """Nothing, and noise."""
    if depth is None:
        depth = 1 + torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    x, y, z = up_of(depth, intrinsics_from_fov(WIDTH, HEIGHT, 60.0), 30.0)
    assert (x, y, z) == pytest.approx((0.0, -math.cos(math.radians(30)), -0.5))
