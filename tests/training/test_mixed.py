"""Mixed views: what changes in a sample, what does not, and what it depends on."""

import logging
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset

from lerobot_msdyn.core.errors import ConfigError, DatasetError, MsdynError
from lerobot_msdyn.dataset import provenance
from lerobot_msdyn.scene import store as saved
from lerobot_msdyn.training import MixedViews
from lerobot_msdyn.training import mixed as mixing
from lerobot_msdyn.views.perturbations.jitter import Jitter
from lerobot_msdyn.views.perturbations.orbit import Orbit

pytestmark = pytest.mark.slow

FRONT, SIDE = "observation.images.front", "observation.images.side"
DEPTH = f"{FRONT}_depth"
WINDOW = {FRONT: [-0.1, 0.0], DEPTH: [-0.1, 0.0], "action": [0.0, 1 / 30]}


def recorded(root: Path, **options: object) -> LeRobotDataset:
    return LeRobotDataset("local/desk", root=root, video_backend="pyav", **options)


def assert_same_but(a: dict, b: dict, changed: set[str]) -> None:
    assert a.keys() == b.keys()
    for key, value in a.items():
        if isinstance(value, torch.Tensor):
            assert (value.shape, value.dtype) == (b[key].shape, b[key].dtype), key
            assert torch.equal(value, b[key]) == (key not in changed), key
        else:
            assert value == b[key]


@pytest.mark.parametrize("options", [{}, {"return_uint8": True}, {"delta_timestamps": WINDOW}])
def test_only_the_rendered_cameras_change(desk: Path, desk_scenes: Path, options: dict) -> None:
    dataset = recorded(desk, **options)
    mixed = MixedViews(dataset, desk_scenes, 1.0)
    for index in (0, 5, 23):
        a, b = dataset[index], mixed[index]
        assert_same_but(a, b, {FRONT, DEPTH})
        scale = 255 if options.get("return_uint8") else 1
        assert 0.005 < (a[FRONT].float() - b[FRONT].float()).abs().mean() / scale < 0.3
        known = (a[DEPTH] > 15) & (b[DEPTH] > 15)
        assert (a[DEPTH] - b[DEPTH])[known].abs().median() < 0.2 * a[DEPTH][known].median()


def test_image_features_as_well(image_desk: Path, desk_scenes: Path) -> None:
    dataset = recorded(image_desk, delta_timestamps={FRONT: [0.0]})
    mixed = MixedViews(dataset, desk_scenes, 1.0)
    assert_same_but(dataset[3], mixed[3], {FRONT, DEPTH})


def test_a_window_has_one_pose(desk: Path, desk_scenes: Path) -> None:
    window = {FRONT: [0.0, 0.0, -1.0]}  # the third is before the episode: its first frame again
    item = MixedViews(recorded(desk, delta_timestamps=window), desk_scenes, 1.0)[0]
    assert torch.equal(item[FRONT][0], item[FRONT][1])
    assert torch.equal(item[FRONT][0], item[FRONT][2])


def test_image_transforms_are_applied(desk: Path, desk_scenes: Path) -> None:
    plain = MixedViews(recorded(desk), desk_scenes, 1.0)
    negative = MixedViews(recorded(desk, image_transforms=lambda image: 1 - image), desk_scenes, 1.0)
    for key in (FRONT, SIDE):
        torch.testing.assert_close(negative[7][key], 1 - plain[7][key])
    assert torch.equal(negative[7][DEPTH], plain[7][DEPTH])


def test_share_and_episodes_without_scenes(desk: Path, desk_scenes: Path, caplog: pytest.LogCaptureFixture) -> None:
    dataset = recorded(desk)
    with caplog.at_level(logging.WARNING, "lerobot_msdyn"):
        mixed = MixedViews(dataset, desk_scenes, 0.5)
        changed = [not torch.equal(dataset[i][FRONT], mixed[i][FRONT]) for i in range(36)]
    assert 5 <= sum(changed[:24]) <= 19
    assert not any(changed[24:])
    assert [record.message for record in caplog.records] == [
        "local/desk: 1 of 3 episodes have no saved scene; their samples stay as recorded"
    ]
    assert_same_but(dataset[4], MixedViews(dataset, desk_scenes, 0.0)[4], set())


def test_a_sample_depends_on_seed_epoch_and_index(desk: Path, desk_scenes: Path) -> None:
    mixed = MixedViews(recorded(desk), desk_scenes, 1.0)
    first = mixed[3][FRONT]
    assert torch.equal(first, mixed[3][FRONT])
    assert torch.equal(first, mixed[-33][FRONT])
    assert torch.equal(first, mixed[2:4][1][FRONT])
    mixed.set_epoch(1)
    assert not torch.equal(first, mixed[3][FRONT])
    assert not torch.equal(first, MixedViews(recorded(desk), desk_scenes, 1.0, seed=1)[3][FRONT])
    some = MixedViews(recorded(desk, episodes=[1]), desk_scenes, 1.0)
    mixed.set_epoch(0)
    assert torch.equal(some[2][FRONT], mixed[14][FRONT]), "by the index in the whole dataset"


@pytest.mark.parametrize("helpers", [0, 1, 3])
def test_a_batch_is_its_samples(desk: Path, desk_scenes: Path, helpers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mixing, "_free_cores", lambda: helpers)
    mixed = MixedViews(recorded(desk), desk_scenes, 0.5)
    order = [30, 1, 13, 7, 20, -34, 16, 1]
    for index, sample in zip(order, mixed.__getitems__(order), strict=True):
        assert_same_but(sample, mixed[index], set())


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.parametrize(("workers", "context"), [(1, "fork"), (2, "spawn"), (4, "fork")])
def test_workers_change_nothing(desk: Path, desk_scenes: Path, workers: int, context: str) -> None:
    mixed = MixedViews(recorded(desk, episodes=[0, 1]), desk_scenes, 0.5)
    order = [1, 13, 7, 20, 2, 16]
    expected = []
    for epoch in (0, 1):
        mixed.set_epoch(epoch)
        expected.append(torch.stack([mixed[i][FRONT] for i in order]))
    loader = torch.utils.data.DataLoader(
        mixed, 2, sampler=order, num_workers=workers, persistent_workers=True, multiprocessing_context=context
    )
    for epoch in (0, 1):
        mixed.set_epoch(epoch)
        assert torch.equal(torch.cat([batch[FRONT] for batch in loader]), expected[epoch])
    assert not torch.equal(*expected)


def test_perturbations(desk: Path, desk_scenes: Path) -> None:
    dataset = recorded(desk)
    assert MixedViews(dataset, desk_scenes).mixer.perturbation == Orbit(azimuth_deg=8.0), "that of the run"
    assert MixedViews(dataset, desk_scenes / saved.FOLDER).mixer.perturbation == Orbit(azimuth_deg=8.0)
    still = MixedViews(dataset, desk_scenes, 1.0, Jitter(translation_m=0.0, translation_rel=0.0, rotation_deg=0.0))
    assert (still[3][FRONT] - dataset[3][FRONT]).abs().mean() < 0.06


def test_trainers_find_what_they_read(desk: Path, desk_scenes: Path) -> None:
    dataset = recorded(desk, episodes=[0, 2])
    mixed = MixedViews(dataset, str(desk_scenes))
    for name in ("meta", "episodes", "num_frames", "num_episodes", "features", "fps", "hf_dataset", "repo_id"):
        assert getattr(mixed, name) is getattr(dataset, name) or getattr(mixed, name) == getattr(dataset, name)
    assert mixed.absolute_to_relative_idx == dataset.absolute_to_relative_idx
    assert len(mixed) == 24
    sampler = EpisodeAwareSampler(
        mixed.meta.episodes["dataset_from_index"],
        mixed.meta.episodes["dataset_to_index"],
        episode_indices_to_use=mixed.episodes,
        absolute_to_relative_idx=mixed.absolute_to_relative_idx,
    )
    assert list(sampler) == list(range(24))
    with pytest.raises(AttributeError, match="absent"):
        _ = mixed.absent


def test_the_output_itself_can_be_mixed(desk: Path, desk_scenes: Path) -> None:
    output = LeRobotDataset("local/desk_msdyn", root=desk_scenes, video_backend="pyav")
    mixed = MixedViews(output, desk_scenes, 1.0)
    assert len(mixed.mixer.cache.scenes) == output.num_episodes == 4
    folders = [mixed.mixer.cache.scenes[episode][FRONT] for episode in range(4)]
    names = [folder.parent.name for folder in folders if isinstance(folder, Path)]
    assert names == ["episode_000000", "episode_000000", "episode_000001", "episode_000001"]


def test_scenes_of_another_dataset_are_refused_by_its_name(desk: Path, desk_scenes: Path) -> None:
    other = LeRobotDataset("local/other", root=desk, video_backend="pyav")
    with pytest.raises(DatasetError, match="the scenes are of local/desk; expected local/other"):
        MixedViews(other, desk_scenes)
    assert len(MixedViews(other, saved.list_scenes(desk_scenes)).mixer.cache.scenes) == 2


def test_episodes_that_the_gate_refused_stay_as_recorded(
    desk: Path, desk_scenes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(desk_scenes, tmp_path / "new")
    rows = provenance.read_provenance(tmp_path / "new")
    assert rows is not None
    for row in rows:
        row["variant"] = -1 if row["source_episode"] == 1 else row["variant"]
    provenance.write_rows(tmp_path / "new", rows)
    with caplog.at_level(logging.WARNING, "lerobot_msdyn"):
        mixed = MixedViews(recorded(desk), tmp_path / "new", 1.0)
    assert list(mixed.mixer.cache.scenes) == [0]
    assert "the gate kept no new view of episodes [1]; they stay as recorded" in caplog.text


def test_a_view_of_nothing_is_brought_nearer(desk: Path, desk_scenes: Path) -> None:
    far, near = (
        Orbit(azimuth_deg=factor * 12.0, elevation_deg=0.0, translation_m=0.0, translation_rel=0.0) for factor in (4, 1)
    )
    bounded, quarter = (MixedViews(recorded(desk), desk_scenes, 1.0, kind) for kind in (far, near))
    bounded.mixer.max_empty, quarter.mixer.max_empty = 0.0, 1.0
    assert torch.equal(bounded[3][FRONT], quarter[3][FRONT])
    bounded.mixer.max_empty = 1.0
    assert not torch.equal(bounded[3][FRONT], quarter[3][FRONT])


def test_scenes_from_memory(desk: Path, desk_scenes: Path) -> None:
    folders = saved.list_scenes(desk_scenes)
    scenes = {0: {FRONT: saved.load(folders[0][FRONT])}}
    mixed = MixedViews(recorded(desk), scenes, 1.0, Orbit(azimuth_deg=8.0))
    assert torch.equal(mixed[3][FRONT], MixedViews(recorded(desk), desk_scenes, 1.0)[3][FRONT])


def test_bad_input_is_named(desk: Path, image_desk: Path, desk_scenes: Path, tmp_path: Path) -> None:
    dataset = recorded(desk)
    with pytest.raises(ConfigError, match=r"probability is 2\.0; expected a value from 0 to 1"):
        MixedViews(dataset, desk_scenes, 2.0)
    with pytest.raises(MsdynError, match="no saved scenes"):
        MixedViews(dataset, tmp_path)
    scene = saved.load(saved.list_scenes(desk_scenes)[0][FRONT])
    with pytest.raises(DatasetError, match=r"no camera 'observation\.images\.top'"):
        MixedViews(dataset, {0: {"observation.images.top": scene}})
    with pytest.raises(DatasetError, match="the scene is of 6 frames of 64x48; expected 12 of 64x48"):
        MixedViews(dataset, {0: {FRONT: replace(scene, camera=scene.camera.select(slice(0, 6)))}})
