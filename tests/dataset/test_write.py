"""Writing: the source's values bit for bit, its other cameras unchanged, nothing half-written."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.core.errors import OutputError
from lerobot_msdyn.dataset.encode import image_stats
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.dataset.read import open_source, read_colour, read_depth
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset

FRONT = "observation.images.front"
RENUMBERED = ("index", "episode_index")


def fingerprint(root: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path.relative_to(root)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def copied(index: int) -> NewEpisode:
    return NewEpisode(index, Provenance("local/desk", index, SOURCE_VARIANT, 0))


def write_upside_down(root: Path, out: Path, indices: tuple[int, ...]) -> list[NewEpisode]:
    """Each episode as it is, and once more with the front camera's pictures upside down."""
    source = open_source("local/desk", root)
    with OutputDataset(source, "local/new", out) as output:
        episodes = []
        for index in indices:
            rgb = read_colour(source, index, FRONT, read_rows(source, index)).flip(1).numpy()
            origin = Provenance("local/desk", index, 0, 0, {FRONT: {"azimuth_deg": 1.5}})
            episodes += [copied(index), output.stage(index, 0, ({FRONT: frame} for frame in rgb), origin)]
        output.finish(episodes, "variants: 1\n")
    return episodes


def assert_same_but_for_new_pictures(
    source: LeRobotDataset, output: LeRobotDataset, episodes: list[NewEpisode]
) -> None:
    position = 0
    for number, episode in enumerate(episodes):
        row = source.meta.episodes[episode.source_index]
        for i in range(row["length"]):
            old, new = source[row["dataset_from_index"] + i], output[position]
            assert old.keys() == new.keys()
            assert (new["index"], new["episode_index"]) == (position, number)
            for key in set(old) - set(RENUMBERED):
                where = (number, i, key)
                if key in episode.pictures.videos or key in episode.pictures.images:
                    assert (old[key].flip(1) - new[key]).abs().mean() < (0.05 if episode.pictures.videos else 1e-6), (
                        where
                    )
                elif isinstance(old[key], torch.Tensor):
                    assert torch.equal(old[key], new[key]), where
                else:
                    assert old[key] == new[key], where
            position += 1
    assert position == len(output)


@pytest.mark.parametrize(("which", "indices"), [("desk", (2, 0)), ("image_desk", (1, 0))])
def test_only_the_new_pictures_differ(
    which: str, indices: tuple[int, ...], request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    root = request.getfixturevalue(which)
    before = fingerprint(root)
    episodes = write_upside_down(root, tmp_path / "new", indices)
    source = LeRobotDataset("local/desk", root=root, video_backend="pyav")
    output = LeRobotDataset("local/new", root=tmp_path / "new", video_backend="pyav")
    assert_same_but_for_new_pictures(source, output, episodes)
    assert output.meta.features == source.meta.features
    assert output.meta.tasks.equals(source.meta.tasks)
    assert (output.meta.fps, output.meta.robot_type) == (source.meta.fps, source.meta.robot_type)
    assert fingerprint(root) == before
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


@pytest.mark.parametrize("which", ["desk", "image_desk"])
def test_new_depth_comes_back_in_metres(which: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    root = request.getfixturevalue(which)
    source = open_source("local/desk", root)
    key = f"{FRONT}_depth"
    rows = read_rows(source, 1)
    rgb = read_colour(source, 1, FRONT, rows).numpy()
    depth = 0.5 * read_depth(source, 1, key, rows)[0].numpy()
    with OutputDataset(source, "local/new", tmp_path / "new") as output:
        frames = ({FRONT: colours, key: metres} for colours, metres in zip(rgb, depth, strict=True))
        output.finish([output.stage(1, 0, frames, copied(1).provenance)], "")
    new = open_source("local/new", tmp_path / "new")
    again = read_depth(new, 0, key, read_rows(new, 0))[0].numpy()
    assert np.abs(again - depth).max() < 0.003  # the step of LeRobot's codes
    old_stats, new_stats = source.stats[key]["mean"], new.stats[key]["mean"]
    assert 0.4 < float(np.squeeze(new_stats)) / float(np.squeeze(old_stats)) < 0.6


def test_parquet_rows_are_the_sources(desk: Path, tmp_path: Path) -> None:
    write_upside_down(desk, tmp_path / "new", (1,))
    old = read_rows(open_source("local/desk", desk), 1)
    new = pq.read_table(next((tmp_path / "new" / "data").rglob("*.parquet")))
    assert new.schema.equals(old.schema, check_metadata=True)
    for start in (0, old.num_rows):
        part = new.slice(start, old.num_rows).drop_columns(list(RENUMBERED))
        assert part.combine_chunks().equals(old.drop_columns(list(RENUMBERED)).combine_chunks())


def test_statistics_are_those_of_the_new_episodes(desk: Path, tmp_path: Path) -> None:
    write_upside_down(desk, tmp_path / "new", (1,))
    source = LeRobotDataset("local/desk", root=desk, video_backend="pyav", episodes=[1])
    output = LeRobotDataset("local/new", root=tmp_path / "new", video_backend="pyav")
    action = torch.stack([source[i]["action"] for i in range(len(source))]).numpy()
    stats = output.meta.stats
    np.testing.assert_allclose(stats["action"]["mean"], action.mean(0), rtol=1e-5)
    np.testing.assert_allclose(stats["action"]["max"], action.max(0), rtol=1e-6)
    assert stats["index"]["max"] == 2 * len(source) - 1
    assert stats["episode_index"]["mean"] == 0.5
    frames = torch.stack([source[i][FRONT] for i in range(len(source))])
    assert stats[FRONT]["mean"].shape == (3, 1, 1)
    np.testing.assert_allclose(stats[FRONT]["mean"].ravel(), frames.mean((0, 2, 3)).numpy(), atol=2e-3)


def test_image_stats_by_hand() -> None:
    samples = np.zeros((2, 3, 4, 4), np.uint8)
    samples[1, 0] = 255
    stats = image_stats(samples)
    np.testing.assert_allclose(stats["mean"].ravel(), [0.5, 0, 0])
    np.testing.assert_allclose(stats["max"].ravel(), [1, 0, 0])
    assert stats["count"] == 2


def test_where_each_episode_came_from(desk: Path, tmp_path: Path) -> None:
    write_upside_down(desk, tmp_path / "new", (2,))
    rows = pq.read_table(tmp_path / "new" / "meta" / "msdyn" / "episodes.parquet").to_pylist()
    assert [(row["source_episode"], row["variant"]) for row in rows] == [(2, SOURCE_VARIANT), (2, 0)]
    assert rows[1]["perturbation"] == '{"observation.images.front": {"azimuth_deg": 1.5}}'
    assert (tmp_path / "new" / "meta" / "msdyn" / "recipe.yaml").read_text() == "variants: 1\n"


def test_a_taken_place_is_left_alone(desk: Path, tmp_path: Path) -> None:
    source = open_source("local/desk", desk)
    (tmp_path / "new").mkdir()
    with pytest.raises(OutputError, match="exists already"):
        OutputDataset(source, "local/new", tmp_path / "new")
    with pytest.raises(OutputError, match="lies inside the source"):
        OutputDataset(source, "local/new", desk / "new")
    assert list(tmp_path.iterdir()) == [tmp_path / "new"]


def test_an_error_leaves_nothing_behind(desk: Path, tmp_path: Path) -> None:
    source = open_source("local/desk", desk)

    def write() -> None:
        with OutputDataset(source, "local/new", tmp_path / "new") as output:
            output.stage(0, 0, [{FRONT: np.zeros((48, 64, 3), np.uint8)}], copied(0).provenance)

    with pytest.raises(OutputError, match="episodes/000000/variant_00: 1 frames were rendered; expected 12"):
        write()
    assert list(tmp_path.iterdir()) == []
