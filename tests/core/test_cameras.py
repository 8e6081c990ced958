"""Cameras and calibration files."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lerobot_msdyn.core.cameras import concatenated, intrinsics_from_fov, read_calibration, static_camera
from lerobot_msdyn.core.errors import PriorError

K = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]
TURNED = {"K": K, "R": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "t": [1.0, 2.0, 3.0]}


def write(tmp_path: Path, content: object) -> Path:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content))
    return path


def test_field_of_view() -> None:
    intrinsics = intrinsics_from_fov(640, 480, 90.0)
    assert float(intrinsics[0, 0]) == pytest.approx(320)
    assert math.degrees(2 * math.atan(320 / float(intrinsics[0, 0]))) == pytest.approx(90)


def test_parts_of_a_track_make_the_track() -> None:
    poses = torch.eye(4).repeat(5, 1, 1)
    poses[:, 0, 3] = torch.arange(5.0)
    track = replace(static_camera(torch.tensor(K), 5, 640, 480), world_from_camera=poses)
    again = concatenated([track.select(slice(0, 2)), track.select(slice(2, 5))])
    assert torch.equal(again.world_from_camera, poses)
    assert (len(again), again.width, again.height) == (5, 640, 480)


def test_static_camera_stands_still() -> None:
    camera = static_camera(torch.tensor(K), 4, 640, 480)
    assert len(camera) == 4
    assert camera.is_static
    assert torch.equal(camera.camera_from_world, torch.eye(4).expand(4, 4, 4))
    assert len(camera.select([1, 3])) == 2


@pytest.mark.parametrize("name", ["observation.images.front", "front"])
def test_calibration_by_key_or_its_last_part(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, {"cameras": {name: TURNED}})
    camera = read_calibration(path, "observation.images.front", 0, 2, 640, 480)
    assert camera is not None
    # World to camera maps x to R x + t, so the camera's centre is -R^T t.
    torch.testing.assert_close(camera.world_from_camera[0, :3, 3], torch.tensor([-2.0, 1.0, -3.0]))
    torch.testing.assert_close(camera.camera_from_world[1, :3, :3], torch.tensor(TURNED["R"]).float())


def test_calibration_per_episode(tmp_path: Path) -> None:
    path = write(tmp_path, {"episodes": {"3": {"cameras": {"front": {"K": K}}}}})
    assert read_calibration(path, "front", 3, 2, 640, 480) is not None
    assert read_calibration(path, "front", 0, 2, 640, 480) is None


@pytest.mark.parametrize("entry", [{}, {"K": [1, 2]}, {"K": K, "R": [1]}, {"K": "x"}])
def test_bad_entry_is_named(tmp_path: Path, entry: dict) -> None:
    path = write(tmp_path, {"cameras": {"front": entry}})
    with pytest.raises(PriorError, match="camera 'front' has no usable K"):
        read_calibration(path, "front", 0, 2, 640, 480)


def test_unreadable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(PriorError, match=r"absent\.json"):
        read_calibration(tmp_path / "absent.json", "front", 0, 2, 640, 480)
