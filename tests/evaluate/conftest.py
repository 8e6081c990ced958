"""One synthetic sequence in both layouts, for several tests."""

from pathlib import Path

import pytest

from lerobot_msdyn.synthetic import make_scene, write_iphone_folder
from lerobot_msdyn.synthetic.scene import SyntheticScene


@pytest.fixture(scope="session")
def push() -> SyntheticScene:
    """What the sequence shows."""
    return make_scene("push", 0, 12, 80, 60)


@pytest.fixture(scope="session")
def sequence(push: SyntheticScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sequence's folder; not to be written to."""
    root = tmp_path_factory.mktemp("iphone") / "push"
    write_iphone_folder(push, root)
    return root
