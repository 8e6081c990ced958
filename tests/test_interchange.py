"""What LeRobot's own tools make of an output."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset, aggregate_datasets
from lerobot.scripts.lerobot_edit_dataset import (
    DeleteEpisodesConfig,
    EditDatasetConfig,
    MergeConfig,
    OperationConfig,
    RecomputeStatsConfig,
    SplitConfig,
    edit_dataset,
)

from lerobot_msdyn.carry import carry_provenance
from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.dataset.card import card_arguments
from lerobot_msdyn.dataset.lineage import recordings
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance, read_provenance
from lerobot_msdyn.dataset.read import open_source, read_colour
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset
from lerobot_msdyn.split import split_by_source

pytestmark = pytest.mark.slow

FRONT = "observation.images.front"


def write_output(desk: Path, out: Path, axis: int, episodes: tuple[int, ...] = (0, 1, 2)) -> None:
    """Each episode as it is, and with the front camera's pictures mirrored along an axis."""
    source = open_source("local/desk", desk)
    with OutputDataset(source, f"local/{out.name}", out) as output:
        new = []
        for index in episodes:
            new.append(NewEpisode(index, Provenance("local/desk", index, SOURCE_VARIANT, axis)))
            rgb = read_colour(source, index, FRONT, read_rows(source, index)).flip(axis).numpy()
            new.append(
                output.stage(index, 0, ({FRONT: frame} for frame in rgb), Provenance("local/desk", index, 0, axis))
            )
        output.finish(new, f"seed: {axis}\n")


@pytest.fixture(scope="module")
def outputs(desk: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two outputs of one source by different recipes."""
    folder = tmp_path_factory.mktemp("outputs")
    for name, axis in (("first", 1), ("second", 2)):
        write_output(desk, folder / name, axis)
    return folder / "first", folder / "second"


@pytest.fixture(scope="module")
def merged(desk: Path, outputs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source and both outputs, merged with LeRobot's tool."""
    root = tmp_path_factory.mktemp("merged") / "all"
    roots = [str(desk), *map(str, outputs)]
    edit(MergeConfig(repo_ids=["local/desk", "local/first", "local/second"], roots=roots), "local/all", new_root=root)
    return root


def edit(operation: OperationConfig, repo_id: str, *, root: Path | None = None, new_root: Path | None = None) -> None:
    """What `lerobot-edit-dataset` does."""
    places = {"root": root and str(root), "new_root": new_root and str(new_root)}
    edit_dataset(EditDatasetConfig(operation, repo_id=root and repo_id, new_repo_id=new_root and repo_id, **places))


def frames(root: Path, episode: int) -> list[dict[str, Any]]:
    dataset = LeRobotDataset("local/x", root=root, video_backend="pyav")
    row = dataset.meta.episodes[episode]
    return [dataset[i] for i in range(row["dataset_from_index"], row["dataset_to_index"])]


def assert_same_frames(a: list[dict[str, Any]], b: list[dict[str, Any]], tolerance: float = 0.0) -> None:
    assert len(a) == len(b)
    for old, new in zip(a, b, strict=True):
        assert old.keys() == new.keys()
        for key in set(old) - {"index", "episode_index", "task"}:
            assert (old[key].float() - new[key].float()).abs().mean() <= tolerance, key


def test_merge_with_the_source(desk: Path, outputs: tuple[Path, Path], merged: Path) -> None:
    assert open_source("local/all", merged).total_episodes == 3 + 6 + 6
    assert_same_frames(frames(merged, 1), frames(desk, 1))
    assert_same_frames(frames(merged, 3 + 3), frames(outputs[0], 3))
    assert_same_frames(frames(merged, 9 + 5), frames(outputs[1], 5))


def test_recordings_are_found_in_what_was_merged(merged: Path) -> None:
    assert read_provenance(merged) is None
    expected = [0, 1, 2] + [0, 0, 1, 1, 2, 2] * 2
    assert recordings(open_source("local/all", merged)) == expected


def test_provenance_is_carried_over(desk: Path, outputs: tuple[Path, Path], merged: Path) -> None:
    assert carry_provenance(merged, [desk, *outputs]) == 15
    rows = read_provenance(merged)
    assert rows is not None
    origins = [(row["source_repo_id"], row["source_episode"], row["variant"]) for row in rows]
    assert origins[:3] == [("local/desk", e, -1) for e in (0, 1, 2)]
    assert origins[3:] == [("local/desk", e, v) for _ in outputs for e in (0, 1, 2) for v in (-1, 0)]
    assert [row["seed"] for row in rows if row["variant"] == 0] == [1, 1, 1, 2, 2, 2]
    assert "6 of the 15 episodes in this dataset are synthetic" in (merged / "README.md").read_text()
    split = split_by_source(merged, 0.34)
    assert split.train == [0, 1, 3, 4, 5, 6, 9, 10, 11, 12]
    assert split.evaluation == [2, 7, 13]
    with pytest.raises(DatasetError, match="episode 3 is in none of the sources"):
        carry_provenance(merged, [desk])


def test_delete_and_split(outputs: tuple[Path, Path], tmp_path: Path) -> None:
    first = outputs[0]
    edit(DeleteEpisodesConfig(episode_indices=[0, 3]), "local/first", root=first, new_root=tmp_path / "less")
    assert_same_frames(frames(tmp_path / "less", 1), frames(first, 2), 0.02)
    assert carry_provenance(tmp_path / "less", [first]) == 4
    rows = read_provenance(tmp_path / "less")
    assert rows is not None
    assert [(row["source_episode"], row["variant"]) for row in rows] == [(0, 0), (1, -1), (2, -1), (2, 0)]
    edit(SplitConfig(splits={"a": [0, 1], "b": [2, 3, 4, 5]}), "local/first", root=first, new_root=tmp_path / "parts")
    assert_same_frames(frames(tmp_path / "parts" / "b", 0), frames(first, 2), 0.02)


def test_recomputed_statistics_are_those_that_were_there(desk: Path, tmp_path: Path) -> None:
    root = tmp_path / "out"
    write_output(desk, root, 1)
    before = open_source("local/out", root).stats
    edit(RecomputeStatsConfig(overwrite=True), "local/out", root=root)
    after = open_source("local/out", root).stats
    for key in ("action", "observation.state", FRONT):
        for name in ("mean", "std", "min", "max"):
            np.testing.assert_allclose(after[key][name], before[key][name], rtol=1e-5, atol=1e-6, err_msg=key)
    assert read_provenance(root) is not None


def test_shards_of_several_runs(desk: Path, tmp_path: Path) -> None:
    shards = [tmp_path / "shard_0", tmp_path / "shard_1"]
    for shard, episodes in zip(shards, ((0, 1), (2,)), strict=True):
        write_output(desk, shard, 1, episodes)
    write_output(desk, tmp_path / "whole", 1)
    aggregate_datasets(["local/a", "local/b"], "local/both", shards, tmp_path / "both")
    carry_provenance(tmp_path / "both", shards)
    whole, both = read_provenance(tmp_path / "whole"), read_provenance(tmp_path / "both")
    assert whole is not None
    assert both is not None
    assert [(r["source_episode"], r["variant"]) for r in both] == [(r["source_episode"], r["variant"]) for r in whole]
    for index in range(6):
        assert_same_frames(frames(tmp_path / "both", index), frames(tmp_path / "whole", index))


def test_the_viewer_opens_it(outputs: tuple[Path, Path], tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from lerobot.scripts.lerobot_dataset_viz import visualize_dataset

    dataset = LeRobotDataset("local/first", root=outputs[0], video_backend="pyav")
    saved = visualize_dataset(dataset, 1, batch_size=4, save=True, output_dir=tmp_path)
    assert saved is not None
    assert saved.stat().st_size > 1000


def test_push_carries_everything(outputs: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import DatasetCard
    from huggingface_hub.utils import filter_repo_objects
    from lerobot.datasets import lerobot_dataset

    calls: dict[str, Any] = {}

    class FakeHub:
        def __getattr__(self, name: str) -> Any:
            return lambda *_, **given: calls.setdefault(name, given)

    def push_card(card: DatasetCard, **_: Any) -> None:
        calls["card"] = str(card)

    monkeypatch.setattr(lerobot_dataset, "HfApi", FakeHub)
    monkeypatch.setattr(DatasetCard, "push_to_hub", push_card)
    root = outputs[0]
    LeRobotDataset("local/first", root=root).push_to_hub(**card_arguments(root, "local/first"))
    upload = calls["upload_folder"]
    names = [str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()]
    sent = set(filter_repo_objects(names, ignore_patterns=upload["ignore_patterns"]))
    assert {"meta/msdyn/episodes.parquet", "meta/msdyn/recipe.yaml", "meta/info.json", "README.md"} <= sent
    assert calls["card"] == (root / "README.md").read_text()
    assert "3 of the 6 episodes in this dataset are synthetic" in calls["card"]
    assert "More Information Needed" not in calls["card"]


def test_the_trainer_splits_as_planned(outputs: tuple[Path, Path]) -> None:
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.factory import make_train_eval_datasets
    from lerobot.policies.act.configuration_act import ACTConfig

    split = split_by_source(outputs[0], 0.3)
    dataset = DatasetConfig(
        "local/first",
        root=str(outputs[0]),
        episodes=split.episodes,
        eval_split=split.eval_split,
        video_backend="pyav",
        use_imagenet_stats=False,
    )
    train, evaluation = make_train_eval_datasets(TrainPipelineConfig(dataset, policy=ACTConfig(push_to_hub=False)))
    assert evaluation is not None
    assert sorted(train.episodes) == split.train == [0, 1, 2, 3]
    assert sorted(evaluation.episodes) == split.evaluation == [4]
    assert {int(i) for i in torch.stack(list(train.hf_dataset["episode_index"]))} == set(split.train)
