"""What a recorder that was killed leaves behind: the leading episodes that are there are used."""

import json
import logging
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.select import lost_episodes, select_episodes
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset

TABLE = Path("meta") / "episodes" / "chunk-000" / "file-000.parquet"


def change_info(root: Path, **values: object) -> None:
    file = root / "meta" / "info.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


@pytest.fixture
def killed(desk: Path, tmp_path: Path) -> Path:
    """Nine episodes are listed, three are there, and a second table of episodes has no footer."""
    root = tmp_path / "killed"
    shutil.copytree(desk, root)
    change_info(root, total_episodes=9, total_frames=108)
    whole = (root / TABLE).read_bytes()
    (root / TABLE).with_name("file-001.parquet").write_bytes(whole[: len(whole) // 2])
    return root


def test_the_episodes_that_are_there_are_used(killed: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = {path: path.read_bytes() for path in killed.rglob("*") if path.is_file()}
    source = open_source("local/killed", killed)
    (message,) = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert "lists 9 episodes, of which 3 (0 to 2) are there and used" in message
    assert select_episodes(source, None) == [0, 1, 2]
    assert lost_episodes(source) == range(3, 9)
    with pytest.raises(DatasetError, match=r"episode 5 is lost: meta/info.json lists 9 episodes, but only 0 to 2"):
        select_episodes(source, [1, 5])
    with pytest.raises(DatasetError, match="no episode 9; it has 3"):
        select_episodes(source, [9])
    with OutputDataset(source, "local/new", tmp_path / "new") as output:
        output.finish([NewEpisode(i, Provenance("local/killed", i, SOURCE_VARIANT, 0)) for i in range(3)], "")
    new = LeRobotDataset("local/new", root=tmp_path / "new", video_backend="pyav")
    assert (new.num_episodes, len(new)) == (3, 36)
    assert new[35]["episode_index"] == 2
    assert before == {path: path.read_bytes() for path in killed.rglob("*") if path.is_file()}


def test_the_advice_mends_the_source(killed: Path) -> None:
    (killed / TABLE).with_name("file-001.parquet").unlink()
    change_info(killed, total_episodes=3, total_frames=36)
    assert len(LeRobotDataset("local/killed", root=killed, video_backend="pyav")) == 36


def test_only_the_leading_episodes_count(desk: Path, tmp_path: Path) -> None:
    root = tmp_path / "gap"
    shutil.copytree(desk, root)
    table = pq.read_table(root / TABLE)
    pq.write_table(table.take([0, 2]), root / TABLE)
    assert open_source("local/gap", root).total_episodes == 1
    pq.write_table(table.slice(1), root / TABLE)
    with pytest.raises(DatasetError, match=r"2 episodes, \[1, 2\]; expected 0 to 2"):
        open_source("local/gap", root)


def test_no_table_of_episodes_was_finished(desk: Path, tmp_path: Path) -> None:
    root = tmp_path / "none"
    shutil.copytree(desk, root)
    (root / TABLE).write_bytes((root / TABLE).read_bytes()[:100])
    with pytest.raises(DatasetError, match=r"file-000.parquet was never finished .*record the dataset again"):
        open_source("local/none", root)
