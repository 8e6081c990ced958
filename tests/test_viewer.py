"""The viewer's recording, without a screen."""

from pathlib import Path

import pytest

from lerobot_msdyn import viewer
from lerobot_msdyn.core.errors import ConfigError, DatasetError, OutputError

pytest.importorskip("rerun")


@pytest.mark.filterwarnings("ignore:.*is deprecated since 0.32:DeprecationWarning")
def test_a_recording_is_written(desk: Path, desk_scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "episode.rrd"
    source = ["--repo", "local/desk", "--root", str(desk), "--scenes", str(desk_scenes)]
    assert viewer.run([*source, "--episode", "1", "--variants", "1", "--save", str(path)]) == 0
    assert f"open it with: rerun {path}" in capsys.readouterr().out
    from rerun.recording import load_recording

    entities = {column.entity_path for column in load_recording(path).schema().component_columns()}
    for name in (
        "source/video",
        "priors/depth",
        "priors/instances/masks",
        "priors/instances/tracks",
        "world/static",
        "world/moving/points",
        "world/moving/ellipsoids",
        "world/motion/level_0",
        "world/cameras/source",
        "world/cameras/new_0",
        "new_0/rendered",
        "new_0/coverage",
    ):
        assert f"/front/{name}" in entities


def test_bad_input_is_named(desk: Path, desk_scenes: Path, tmp_path: Path) -> None:
    source = ["--repo", "local/desk", "--root", str(desk), "--save", str(tmp_path / "a.rrd")]
    with pytest.raises(ConfigError, match="which dataset"):
        viewer.run([])
    with pytest.raises(DatasetError, match="no saved scene of episode 2"):
        viewer.run([*source, "--scenes", str(desk_scenes), "--episode", "2"])
    with pytest.raises(OutputError, match="no folder"):
        viewer.run([*source, "--save", str(tmp_path / "absent" / "a.rrd")])
