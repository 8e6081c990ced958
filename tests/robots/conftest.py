"""A robot that no one has built."""

from pathlib import Path

import pytest
from made_up_arms import write_arm
from ridden import Ridden, carried

from lerobot_msdyn.robots import Robot, load_robot


@pytest.fixture(autouse=True, scope="session")
def libraries() -> None:
    pytest.importorskip("yourdfpy")


@pytest.fixture(scope="session")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_arm(tmp_path_factory.mktemp("robots") / "arm")


@pytest.fixture(scope="session")
def arm(urdf: Path) -> Robot:
    return load_robot(urdf)


@pytest.fixture(scope="session")
def ridden() -> Ridden:
    return carried()
