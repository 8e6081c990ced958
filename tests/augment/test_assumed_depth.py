"""What is said where depth is assumed, and what is fetched where that is asked for."""

import logging
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment import assumed_depth
from lerobot_msdyn.augment.assumed_depth import say_assumed_depth
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.errors import ConfigError, PriorError

METRIC = "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
SOURCE = Mock(spec=LeRobotDatasetMetadata)


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of what was fetched, on a machine without models."""
    names: list[str] = []

    def fetch(name: str) -> Path:
        names.append(name)
        return Path(name)

    for variable in ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(assumed_depth, "fetch", fetch)
    monkeypatch.setattr(assumed_depth, "find_model", lambda name: None)
    monkeypatch.setattr(assumed_depth, "has_library", lambda name: True)
    monkeypatch.setattr(assumed_depth, "demand_library", lambda *args: None)
    monkeypatch.setattr(assumed_depth, "depth_key_of", lambda source, key: None)
    return names


def said(caplog: pytest.LogCaptureFixture, config: AugmentConfig, cameras: tuple[str, ...] = ("front",)) -> list[str]:
    with caplog.at_level(logging.INFO):
        say_assumed_depth(SOURCE, cameras, config)
    return [record.message for record in caplog.records]


def test_the_plane_is_announced_with_the_better_model_and_its_size_in_one_line(fetched, caplog) -> None:
    assert said(caplog, AugmentConfig()) == [
        "no recorded depth: scenes are built on a table plane seen from 0.5 m at 35 degrees (--camera.height_m, "
        "--camera.tilt_deg); keep the changes of view small. Depth would be better with "
        f"{METRIC} (99 MB, Apache-2.0): add --fetch_models true"
    ]
    assert fetched == []


def test_of_a_calibrated_robot_the_table_is_named(fetched, caplog) -> None:
    config = AugmentConfig(camera=CameraConfig(calibration=Path("calibration.json")))
    [line] = said(caplog, config)
    assert line.startswith(
        "no recorded depth: scenes are built on the table that the robot stands on, and what vertical edges "
        "say of things on it; "
    )
    assert "99 MB" in line
    caplog.clear()
    assert "several calibrated cameras" in said(caplog, config, ("front", "side"))[0]


def test_before_a_camera_that_moves_its_way_is_named(fetched, caplog) -> None:
    for camera in (CameraConfig(poses="sfm"), CameraConfig(pose_columns={"front": "observation.pose"})):
        [line] = said(caplog, AugmentConfig(camera=camera, allow_moving=True))
        assert line.startswith("no recorded depth: scenes are built on what the camera's own way tells, ")
        caplog.clear()


def test_the_model_is_fetched_where_that_is_asked_for(fetched, caplog) -> None:
    assert said(caplog, AugmentConfig(fetch_models=True)) == [
        f"depth by {METRIC}: depth_anything_metric",
    ]
    assert fetched == ["depth_anything_metric"]


def test_offline_nothing_is_fetched_and_the_plane_is_taken(fetched, caplog, monkeypatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    [line] = said(caplog, AugmentConfig(fetch_models=True))
    assert line.endswith("(99 MB, Apache-2.0): nothing is downloaded while HF_HUB_OFFLINE is set")
    assert fetched == []


def test_nothing_is_said_or_fetched_where_depth_is_not_assumed(fetched, caplog, monkeypatch) -> None:
    assert said(caplog, AugmentConfig(fetch_models=True, priors=PriorsConfig(depth="plane"))) == []
    with monkeypatch.context() as patch:
        patch.setattr(assumed_depth, "find_model", lambda name: SimpleNamespace())
        assert said(caplog, AugmentConfig(fetch_models=True)) == []
    with monkeypatch.context() as patch:
        patch.setattr(assumed_depth, "depth_key_of", lambda source, key: f"{key}_depth")
        assert said(caplog, AugmentConfig(fetch_models=True)) == []
    assert fetched == []


def test_what_cannot_be_fetched_stops_the_run(fetched, caplog, monkeypatch) -> None:
    mine = PriorsConfig(depth_anything_metric_model="me/mine")
    with pytest.raises(ConfigError, match=r"me/mine is no known model: fetch it with: hf download me/mine"):
        said(caplog, AugmentConfig(fetch_models=True, priors=mine))
    assert "better" not in said(caplog, AugmentConfig(priors=mine))[0]

    def missing(*args: str) -> None:
        raise PriorError("needs transformers")

    with monkeypatch.context() as without_network:
        without_network.setattr(assumed_depth, "fetch", missing)
        with pytest.raises(PriorError, match="; without --fetch_models true depth is that of an assumed table plane"):
            said(caplog, AugmentConfig(fetch_models=True))
    monkeypatch.setattr(assumed_depth, "demand_library", missing)
    with pytest.raises(PriorError, match="needs transformers"):
        said(caplog, AugmentConfig(fetch_models=True))
    assert fetched == []
