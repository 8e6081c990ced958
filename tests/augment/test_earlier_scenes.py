"""New views of scenes that an earlier run has kept (--scenes): nothing is fitted again."""

import shutil
from pathlib import Path

import pytest
import torch
from augment_command import FRONT, run
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.core.serialise import ValueFileError
from lerobot_msdyn.reconstruction.on_disk import JUDGED, load_reconstruction
from lerobot_msdyn.scene.store import list_scenes


def flags(desk: Path, scenes: Path, out: Path) -> list[str]:
    given = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(out), "--scenes", str(scenes)]
    return [*given, "--episodes", "[0,1]", "--cameras", "[front]", "--perturbation.azimuth_deg", "8"]


def pictures(root: Path, episode: int) -> torch.Tensor:
    dataset = LeRobotDataset("local/new", root=root, episodes=[episode], video_backend="pyav")
    return torch.stack([frame[FRONT] for frame in dataset])


def test_the_same_views_come_of_kept_scenes_without_a_fit(
    desk: Path, desk_scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fitted_again(*_: object, **__: object) -> None:
        raise AssertionError("fitted again")

    monkeypatch.setattr("lerobot_msdyn.augment.episode.reconstruct", fitted_again)
    assert run(*flags(desk, desk_scenes, tmp_path / "new"), "--variants", "2") == 0
    for before, now in ((1, 1), (3, 4)):  # the recorded one, then the first variant; of one and of two variants
        assert torch.equal(pictures(desk_scenes, before), pictures(tmp_path / "new", now))
    assert not torch.equal(pictures(tmp_path / "new", 1), pictures(tmp_path / "new", 2))
    assert (tmp_path / "new" / "report.html").stat().st_size > 0
    assert f"scenes: {desk_scenes.name}" in (tmp_path / "new" / "meta" / "msdyn" / "recipe.yaml").read_text()


def test_a_dry_run_knows_that_nothing_is_fitted(
    desk: Path, desk_scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lerobot_msdyn.augment.cost.reconstruct", None)
    assert run(*flags(desk, desk_scenes, tmp_path / "new"), "--dry_run") == 0
    assert "plan (nothing is written)" in capsys.readouterr().out


def test_scenes_of_another_dataset_are_refused(
    desk: Path, desk_scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = flags(desk, desk_scenes, tmp_path / "new")
    given[given.index("local/desk")] = "local/other"
    assert run(*given) == 2
    assert (
        f"--scenes {desk_scenes} holds scenes of local/desk; expected those of local/other" in capsys.readouterr().err
    )
    assert not (tmp_path / "new").exists()


def test_an_episode_without_a_scene_is_skipped_by_name(
    desk: Path, desk_scenes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    given = flags(desk, desk_scenes, tmp_path / "new")
    given[given.index("[0,1]")] = "[1,2]"
    assert run(*given, "--variants", "1") == 1
    assert f"local/desk episode 2: {desk_scenes} has no scene of {FRONT}" in caplog.text


def test_a_scene_without_what_views_are_judged_by_is_named(desk_scenes: Path, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    shutil.copytree(list_scenes(desk_scenes)[0][FRONT], folder)
    (folder / JUDGED).unlink()
    with pytest.raises(ValueFileError, match=r"judged\.safetensors .*--save_scenes true"):
        load_reconstruction(folder)
