"""Saved reconstructions: what is kept, and what is refused."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from lerobot_msdyn.core.errors import MsdynError, OutputError
from lerobot_msdyn.scene import store as saved
from lerobot_msdyn.scene.store import SavedScene

FRONT = "observation.images.front"


@pytest.fixture
def scene(desk_scenes: Path) -> SavedScene:
    return saved.load(saved.list_scenes(desk_scenes)[1][FRONT])


def test_augment_keeps_a_scene_per_episode_and_camera(desk_scenes: Path, scene: SavedScene) -> None:
    assert {episode: list(cameras) for episode, cameras in saved.list_scenes(desk_scenes).items()} == {
        0: [FRONT],
        1: [FRONT],
    }
    assert saved.list_scenes(desk_scenes / saved.FOLDER) == saved.list_scenes(desk_scenes)
    assert dataclasses.asdict(scene.source) == {"repo_id": "local/desk", "episode": 1, "camera": FRONT, "fps": 30}
    assert (len(scene), scene.camera.width, scene.camera.height) == (12, 64, 48)
    assert scene.starts == (0, 6)
    assert [window.frames for window in scene.windows] == [6, 6]
    assert scene.metric
    assert 0.3 < scene.distance < 3
    assert scene.priors["depth"]["provider"] == "recorded"
    assert scene.windows_of(torch.tensor([0, 5, 6, 11])).tolist() == [0, 0, 1, 1]


def test_what_is_saved_comes_back(scene: SavedScene, tmp_path: Path) -> None:
    for _ in range(2):  # the second replaces the first
        again = saved.load(saved.save(scene, tmp_path))
    assert dataclasses.replace(again, windows=(), camera=scene.camera) == dataclasses.replace(scene, windows=())
    torch.testing.assert_close(again.camera.world_from_camera, scene.camera.world_from_camera)
    for window, other in zip(again.windows, scene.windows, strict=True):
        assert window.tensors().keys() == other.tensors().keys()
        assert all(torch.equal(tensor, other.tensors()[name]) for name, tensor in window.tensors().items())
    assert again.size_in_bytes == scene.size_in_bytes > 10_000
    assert [path.name for path in (tmp_path / "episode_000001").iterdir()] == [FRONT]


def test_a_place_that_cannot_be_written_is_the_disks_fault(scene: SavedScene, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        saved.save(scene, tmp_path / "file")


def test_what_cannot_be_read_is_named(scene: SavedScene, tmp_path: Path) -> None:
    with pytest.raises(MsdynError, match=r"no saved scenes in .*--save_scenes true"):
        saved.list_scenes(tmp_path)
    folder = saved.save(scene, tmp_path)
    header = folder / "scene.json"
    content = json.loads(header.read_text())
    for text, message in (
        (json.dumps(content | {"schema": 99}), "schema is 99; expected 1"),
        (json.dumps({key: value for key, value in content.items() if key != "metric"}), "KeyError: 'metric'"),
        ("[]", "not the header"),
        ("{", "not the header"),
    ):
        header.write_text(text)
        with pytest.raises(MsdynError, match=message):
            saved.load(folder)
    header.write_text(json.dumps(content))
    (folder / "camera.safetensors").write_bytes(b"no")
    with pytest.raises(MsdynError, match="not a readable saved scene"):
        saved.load(folder)
