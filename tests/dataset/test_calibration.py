"""Calibration files: which camera they name, and what is refused."""

import json
from pathlib import Path

import pytest
import torch

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.dataset.calibration import read_calibration

K = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]
TURNED = {"K": K, "R": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "t": [1.0, 2.0, 3.0]}


def write(tmp_path: Path, content: object) -> Path:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("name", ["observation.images.front", "front"])
def test_calibration_by_key_or_its_last_part(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, {"cameras": {name: TURNED}})
    camera = read_calibration(path, "observation.images.front", 0, 2, 640, 480)
    assert camera is not None
    # World to camera maps x to R x + t, so the camera's centre is -R^T t.
    torch.testing.assert_close(camera.world_from_camera[0, :3, 3], torch.tensor([-2.0, 1.0, -3.0]))
    torch.testing.assert_close(camera.camera_from_world[1, :3, :3], torch.tensor(TURNED["R"]).float())
    assert camera.world == "calibration"


def test_calibration_per_episode(tmp_path: Path) -> None:
    path = write(tmp_path, {"episodes": {"3": {"cameras": {"front": {"K": K}}}}})
    camera = read_calibration(path, "front", 3, 2, 640, 480)
    assert camera is not None
    assert camera.world == ""  # without a pose it is the camera's own frame
    assert read_calibration(path, "front", 0, 2, 640, 480) is None


@pytest.mark.parametrize("entry", [{}, {"K": [1, 2]}, {"K": K, "R": [1]}, {"K": "x"}])
def test_bad_entry_is_named(tmp_path: Path, entry: dict) -> None:
    path = write(tmp_path, {"cameras": {"front": entry}})
    with pytest.raises(PriorError, match="camera 'front' has no usable K"):
        read_calibration(path, "front", 0, 2, 640, 480)


def test_unreadable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(PriorError, match=r"absent\.json"):
        read_calibration(tmp_path / "absent.json", "front", 0, 2, 640, 480)


@pytest.mark.parametrize("content", [[1, 2], {"cameras": "front"}, {"episodes": {"0": 3}}, "front"])
def test_a_file_without_cameras_by_name_is_refused(tmp_path: Path, content: object) -> None:
    path = write(tmp_path, content)
    with pytest.raises(PriorError, match=r"calibration\.json: calibration cannot be read"):
        read_calibration(path, "front", 0, 2, 640, 480)
