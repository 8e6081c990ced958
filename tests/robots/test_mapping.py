"""State -> joint angles, by names and units."""

import math

import numpy as np
import pytest

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.robots import Robot, map_joints
from lerobot_msdyn.robots.mapping import in_units

NAMES = ["gripper.pos", "pan.pos", "LIFT.pos", "elbow.pos", "wrist.pos", "roll.pos"]


def moving(low: float, high: float) -> np.ndarray:
    return np.linspace(0, 1, 20)[:, None] * (high - low) + np.full((1, 6), low)


def test_names_in_another_order(arm: Robot) -> None:
    state = moving(-90, 90)
    state[:, 0] = 50
    mapped = map_joints(arm, NAMES, state)
    assert mapped.columns.tolist() == [1, 2, 3, 4, 5, 0]
    values = mapped.values(state)
    assert values[-1, 0] == pytest.approx(math.pi / 2)
    assert values[-1, 5] == pytest.approx((1.4 - 0.2) / 2)  # half open


@pytest.mark.parametrize(
    ("units", "low", "high", "expected"),
    [("radians", -1.5, 1.5, 1.5), ("ticks", 1024, 3072, math.pi / 2), ("degrees", -60, 60, math.pi / 3)],
)
def test_units_are_told_from_the_values(arm: Robot, units: str, low: float, high: float, expected: float) -> None:
    mapped = map_joints(arm, NAMES, moving(low, high))
    assert mapped.units == units
    assert mapped.values(moving(low, high))[-1, 0] == pytest.approx(expected)


def test_normalised_values_are_those_of_the_range(arm: Robot) -> None:
    assert map_joints(arm, NAMES, moving(-100, 100), "normalised").values(moving(-100, 100))[-1, 0] == pytest.approx(
        1.9
    )


def test_the_same_state_in_other_units(arm: Robot) -> None:
    state = moving(-90, 90)
    state[:, 0] = 50
    other = in_units(arm, map_joints(arm, NAMES, state), "normalised")
    assert other.values(state) == pytest.approx(map_joints(arm, NAMES, state, "normalised").values(state))


@pytest.mark.parametrize("style", ["{}", "{}.pos", "{}_joint", "k{}", "{}Joint"])
def test_names_in_other_styles(arm: Robot, style: str) -> None:
    names = [style.format(name.capitalize()) for name in ("pan", "lift", "elbow", "wrist", "roll", "gripper")]
    assert map_joints(arm, names, moving(-50, 50)).columns.tolist() == list(range(6))


def test_joints_that_are_not_recorded_rest(arm: Robot) -> None:
    state = moving(-50, 50)[:, :5]
    mapped = map_joints(arm, ["pan", "lift", "elbow", "wrist", "roll"], state)
    assert mapped.columns[5] == -1
    assert mapped.values(state)[:, 5].tolist() == [0] * 20


def test_unknown_names_are_taken_in_order(arm: Robot, caplog: pytest.LogCaptureFixture) -> None:
    mapped = map_joints(arm, [f"motor_{k}" for k in range(6)], moving(-50, 50))
    assert mapped.columns.tolist() == list(range(6))
    assert "taken in its order" in caplog.text


def test_renamed_joints(arm: Robot) -> None:
    mapped = map_joints(arm, ["a", "b", "c"], moving(-50, 50)[:, :3], renamed={"b": "elbow"})
    assert mapped.columns.tolist() == [-1, -1, 1, -1, -1, -1]


@pytest.mark.parametrize(
    ("names", "state", "expected"),
    [
        (["ee.x", "ee.y", "ee.z", "ee.roll", "ee.pitch", "ee.yaw"], moving(-1, 1), "inverse kinematics"),
        (["a", "b", "c"], moving(-50, 50)[:, :3], "none agrees, and there are 3 numbers for 6 joints"),
        (NAMES, moving(5, 5), "no joint of arm moves"),
        (NAMES, moving(5, 50) * np.nan, "NaN"),
    ],
)
def test_what_is_no_arm_is_named(arm: Robot, names: list[str], state: np.ndarray, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        map_joints(arm, names, state)


def test_wrong_settings_are_named(arm: Robot) -> None:
    with pytest.raises(ConfigError, match="expected one of auto, degrees"):
        map_joints(arm, NAMES, moving(-50, 50), "gradians")
    with pytest.raises(ConfigError, match="expected joints of arm: pan, lift"):
        map_joints(arm, NAMES, moving(-50, 50), renamed={"pan.pos": "shoulder"})
