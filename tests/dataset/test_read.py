"""Reading: what comes out of an episode, and how bad datasets are named."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.core.errors import DatasetError, EpisodeError
from lerobot_msdyn.dataset.chroma import with_chroma
from lerobot_msdyn.dataset.read import open_source, read_episode

FRONT, SIDE = "observation.images.front", "observation.images.side"


def test_an_episode_is_what_lerobot_returns(desk: Path) -> None:
    episode = read_episode(open_source("local/desk", desk), 1, [FRONT, SIDE], CameraConfig())
    dataset = LeRobotDataset("local/desk", root=desk, video_backend="pyav", depth_output_unit="m")
    start = dataset.meta.episodes[1]["dataset_from_index"]
    assert len(episode) == dataset.meta.episodes[1]["length"]
    for i in range(len(episode)):
        item = dataset[start + i]
        for key in (FRONT, SIDE):
            view = episode.views[key]
            decoded = (item[key].permute(1, 2, 0) * 255).round().to(torch.uint8)
            assert torch.equal(view.rgb[i], torch.from_numpy(next(with_chroma([decoded.numpy()]))))
            assert view.depth is not None
            assert torch.equal(view.depth[i], item[f"{key}_depth"][0])
        assert episode.state is not None
        assert episode.action is not None
        assert torch.equal(episode.state[i], item["observation.state"])
        assert torch.equal(episode.action[i], item["action"])
        assert episode.task == item["task"]
    assert episode.views[FRONT].depth_range == (0.01, 10.0)


def test_an_image_dataset_is_read_too(image_desk: Path) -> None:
    episode = read_episode(open_source("local/desk", image_desk), 1, [FRONT], CameraConfig())
    dataset = LeRobotDataset("local/desk", root=image_desk, video_backend="pyav")
    item = dataset[dataset.meta.episodes[1]["dataset_from_index"] + 3]
    assert torch.equal(episode.views[FRONT].rgb[3].permute(2, 0, 1).float() / 255, item[FRONT])


def test_depth_is_left_out_on_request(desk: Path) -> None:
    episode = read_episode(open_source("local/desk", desk), 0, [FRONT], CameraConfig(), recorded_depth=False)
    assert episode.views[FRONT].depth is None


def test_no_such_dataset(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no dataset in"):
        open_source("local/absent", tmp_path / "absent")
    assert not (tmp_path / "absent").exists()
    with pytest.raises(DatasetError, match="no dataset 'local/absent'"):
        open_source("local/absent")


def copy_with_info(desk: Path, tmp_path: Path, **changes: object) -> Path:
    root = tmp_path / "copy"
    shutil.copytree(desk, root)
    path = root / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return root


@pytest.mark.parametrize(("version", "hint"), [("v2.1", "--convert"), ("v2.0", "v2.1 with an older")])
def test_an_old_version_names_the_converter(desk: Path, tmp_path: Path, version: str, hint: str) -> None:
    with pytest.raises(DatasetError, match=f"version {version}; expected v3.0.*{hint}"):
        open_source("local/desk", copy_with_info(desk, tmp_path, codebase_version=version))


def test_paths_that_leave_the_dataset_are_refused(desk: Path, tmp_path: Path) -> None:
    root = copy_with_info(desk, tmp_path, data_path="../../secret-{chunk_index}-{file_index}.parquet")
    with pytest.raises(DatasetError, match="leaves the dataset's folder"):
        open_source("local/desk", root)
    shutil.rmtree(root)
    root = copy_with_info(desk, tmp_path)
    data = next((root / "data").rglob("*.parquet"))
    data.rename(tmp_path / "secret.parquet")
    data.symlink_to(tmp_path / "secret.parquet")
    with pytest.raises(EpisodeError, match="outside of"):
        read_episode(open_source("local/desk", root), 0, [FRONT], CameraConfig())


def test_a_truncated_video_is_an_error_of_that_episode(desk: Path, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(desk, root)
    video = next((root / "videos" / FRONT).rglob("*.mp4"))
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    with pytest.raises(
        EpisodeError, match=r"episode 2, observation.images.front: .*(\.mp4 cannot be decoded|for 12 rows)"
    ):
        read_episode(open_source("local/desk", root), 2, [FRONT], CameraConfig())


def test_a_missing_video_is_an_error_of_that_episode(desk: Path, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(desk, root)
    next((root / "videos" / FRONT).rglob("*.mp4")).unlink()
    with pytest.raises(EpisodeError, match="is absent"):
        read_episode(open_source("local/desk", root), 0, [FRONT], CameraConfig())
