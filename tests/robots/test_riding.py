"""The command for a camera on a link: from a dataset to poses that other commands read."""

from pathlib import Path

import numpy as np
import pytest
from ridden import FRAMES, HEIGHT, WIDTH, WRIST, Ridden, write_gantry, write_ridden

from lerobot_msdyn import calibrate
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.priors.exchange import read_exchange


@pytest.fixture(scope="module")
def recorded(ridden: Ridden, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ridden(tmp_path_factory.mktemp("ridden") / "ds", ridden)


def flags(recorded: Path, urdf: Path, *more: str) -> list[str]:
    return ["--repo=local/ridden", f"--root={recorded}", f"--robot.urdf={urdf}", "--cameras=[wrist]", *more]


def test_poses_of_a_camera_on_a_link(
    recorded: Path, ridden: Ridden, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, links, eye = ridden
    out = tmp_path / "poses"
    urdf = write_gantry(tmp_path / "gantry")
    assert calibrate.run(flags(recorded, urdf, "--link=flange", f"--out={out}")) == 0
    assert "2 files, for --camera.poses" in capsys.readouterr().out
    for episode in range(2):
        path = out / f"episode_{episode:06d}" / f"{WRIST}.npz"
        content = read_exchange(path, FRAMES, HEIGHT, WIDTH, episode, WRIST)
        assert content.w2c is not None
        assert content.world == "robot"
        away = np.linalg.norm(np.linalg.inv(content.w2c)[2:-2, :3, 3] - (links @ eye)[2:-2, :3, 3], axis=1)
        assert np.median(away) < 0.02  # m


def test_a_link_that_is_not_there_is_named(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'wrist': gantry has no such link; expected one of base, x_link"):
        calibrate.run(flags(recorded, write_gantry(tmp_path / "gantry"), "--link=wrist", f"--out={tmp_path / 'out'}"))
    assert not (tmp_path / "out").exists()
