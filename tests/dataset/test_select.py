"""Which episodes and cameras are worked on."""

from pathlib import Path

import pytest

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.select import is_wrist_camera, select_cameras, select_episodes

FRONT, SIDE = "observation.images.front", "observation.images.side"


def test_cameras_by_key_or_last_part_and_never_the_wrist(desk: Path, image_desk: Path) -> None:
    source = open_source("local/desk", desk)
    assert select_cameras(source, None) == [FRONT, SIDE]
    assert select_cameras(source, ["side"]) == [SIDE]
    assert select_cameras(open_source("local/desk", image_desk), None) == [FRONT]
    with pytest.raises(DatasetError, match=r"no colour camera 'top'; it has .*front.*side"):
        select_cameras(source, ["top"])
    with pytest.raises(DatasetError, match="front_depth"):
        select_cameras(source, ["front_depth"])


def test_episode_out_of_range(desk: Path) -> None:
    source = open_source("local/desk", desk)
    assert select_episodes(source, None) == [0, 1, 2]
    assert select_episodes(source, [2, 0, 2]) == [0, 2]
    with pytest.raises(DatasetError, match=r"no episode 3, -1; it has 3 \(0 to 2\)"):
        select_episodes(source, [0, 3, -1])


@pytest.mark.parametrize(
    "name", ["wrist", "left_hand", "gripper_cam", "eye_in_hand", "end_effector", "tool0", "handcam", "leftWrist"]
)
def test_names_of_cameras_on_the_robot(name: str) -> None:
    assert is_wrist_camera(f"observation.images.{name}")


@pytest.mark.parametrize(
    "name", ["front", "top", "overhead", "side", "laptop", "handover_view", "toolbox", "secondhand"]
)
def test_names_of_cameras_beside_the_robot(name: str) -> None:
    assert not is_wrist_camera(f"observation.images.{name}")


def test_a_wrist_camera_is_rendered_only_where_that_is_allowed(image_desk: Path) -> None:
    source = open_source("local/desk", image_desk)
    wrist = "observation.images.wrist"
    assert wrist not in select_cameras(source, None)
    with pytest.raises(DatasetError, match=r"wrist moves with the robot, by its name.*leave it out"):
        select_cameras(source, ["wrist"])
    assert select_cameras(source, ["wrist"], allow_moving=True) == [wrist]
    assert wrist in select_cameras(source, None, allow_moving=True)
