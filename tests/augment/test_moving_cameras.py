"""Cameras that move with the robot are told from the others."""

from pathlib import Path

import pytest
import torch
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment import moving_cameras
from lerobot_msdyn.augment.moving_cameras import correlation, still_cameras, why_moving
from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import DatasetError, EpisodeError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.read import Episode, EpisodeSource, open_source
from lerobot_msdyn.dataset.select import select_cameras

FRAMES, WIDTH, HEIGHT = 60, 160, 120


def episode(shift: torch.Tensor, state: torch.Tensor | None) -> Episode:
    """A textured picture that is shifted by so many pixels at each frame."""
    texture = torch.randint(0, 255, (HEIGHT // 4, WIDTH // 4, 3), generator=torch.Generator().manual_seed(0))
    picture = texture.to(torch.uint8).repeat_interleave(4, 0).repeat_interleave(4, 1)
    rgb = torch.stack([picture.roll(int(x), dims=1) for x in shift])
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    source = EpisodeSource("local/synthetic", Path(), 0)
    return Episode(source, 30, torch.arange(FRAMES) / 30, {"top": View(rgb, camera)}, state, None, "")


def stop_and_go() -> torch.Tensor:
    speed = torch.zeros(FRAMES)
    speed[5:20], speed[30:40], speed[48:] = 3.0, -2.0, 1.0
    return speed.cumsum(0)


def to_and_fro() -> torch.Tensor:
    speed = torch.zeros(FRAMES)
    speed[:12], speed[20:34], speed[42:54] = 1.0, -1.0, 1.0
    return speed.cumsum(0)


def test_a_camera_on_the_arm_moves_when_the_state_does() -> None:
    path = to_and_fro()
    on_arm = episode(path.round(), path[:, None])
    assert on_arm.state is not None
    assert correlation(on_arm.state, on_arm.views["top"].rgb) > 0.8
    assert "with the robot" in why_moving(on_arm, "top", "off")
    assert "no state" in why_moving(episode(path.round(), None), "top", "off")


def test_a_camera_that_stands_or_drifts_by_itself_is_not_refused() -> None:
    path = stop_and_go()
    assert why_moving(episode(torch.zeros(FRAMES), path[:, None]), "top", "off") == ""
    assert why_moving(episode(torch.arange(FRAMES) // 6, path[:, None]), "top", "off") == ""


def test_a_camera_whose_picture_goes_far_is_refused_whatever_the_state() -> None:
    anything = torch.rand(FRAMES, 1, generator=torch.Generator().manual_seed(0))
    for path in (2 * torch.arange(FRAMES), stop_and_go().round()):
        assert "does not stand still" in why_moving(episode(path, anything), "top", "off")


def test_cameras_on_stands_are_kept(desk: Path) -> None:
    source = open_source("local/desk", desk)
    cameras = select_cameras(source, None)
    assert still_cameras(source, [0], cameras, Recipe()) == cameras


@pytest.fixture
def on_the_arm(desk: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Episode 0 of `desk` cannot be read, and all cameras move with the robot; the episodes that were asked for."""
    asked: list[int] = []

    def read(source: LeRobotDatasetMetadata, index: int, *rest: object, **more: object) -> tuple[Episode, dict]:
        asked.append(index)
        if index == 0:
            raise EpisodeError("local/desk episode 0: it is damaged")
        return episode(stop_and_go().round(), stop_and_go()[:, None]), {}

    monkeypatch.setattr(moving_cameras, "read_recorded", read)
    return asked


def test_an_episode_that_cannot_be_read_lets_no_camera_pass(desk: Path, on_the_arm: list[int]) -> None:
    source = open_source("local/desk", desk)
    with pytest.raises(DatasetError, match=r"top is refused: its background moves.*does not stand still"):
        still_cameras(source, [0, 1, 2], ["top"], Recipe(include_source=False))
    assert still_cameras(source, [1], ["top"], Recipe()) == []
    with pytest.raises(DatasetError, match="top is refused"):
        still_cameras(source, [1], ["top"], Recipe(cameras=["top"]))
    assert on_the_arm[:2] == [0, 1]


def test_where_no_episode_can_be_read_no_camera_passes(desk: Path, on_the_arm: list[int]) -> None:
    with pytest.raises(EpisodeError, match=r"none of 1 episodes can be read.*First: .*episode 0: it is damaged"):
        still_cameras(open_source("local/desk", desk), [0], ["top"], Recipe())
