"""Write a new LeRobot dataset: the source's rows bit for bit, its other cameras copied, new pictures encoded alike.

Everything is prepared in a hidden folder beside the output, which appears by one rename when it is complete:

    .<output>.partial/
      staged/episode_000003_variant_00/<camera>.mp4    one new episode's pictures
      scenes/episode_000003/<camera>/                  saved scenes, where they are asked for
      dataset/                                         the dataset as it is put together
"""

import copy
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import (
    auto_downsample_height_width,
    compute_episode_stats,
    sample_indices,
)
from lerobot.datasets.io_utils import write_info, write_tasks
from lerobot.datasets.utils import update_chunk_file_indices
from lerobot.datasets.video_utils import concatenate_video_files, get_video_duration_in_s

from lerobot_msdyn import saved
from lerobot_msdyn.episode import depth_units_per_metre, inside_root, read_colour, read_depth, read_rows
from lerobot_msdyn.errors import OutputError
from lerobot_msdyn.provenance import Provenance, write_provenance, write_unseen
from lerobot_msdyn.staging import StagedPictures, Stats, image_stats, stage_pictures
from lerobot_msdyn.video import cut_video, encoder_of

MEGABYTE = 1024**2


@dataclass(frozen=True)
class NewEpisode:
    """One episode of the output: a source episode with some cameras' pictures replaced."""

    source_index: int
    provenance: Provenance
    pictures: StagedPictures = field(default_factory=StagedPictures)  # none for a copy of the source's episode
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)  # of what was never seen, see `write_unseen`
    dropped: str = ""  # why there is no such episode in the end: the gate's reason


class OutputDataset:
    """A dataset in the making. Use as a context: leaving it by an error removes what was prepared."""

    def __init__(self, source: LeRobotDatasetMetadata, repo_id: str, root: Path) -> None:
        """Prepare the work folder.

        Raises:
            OutputError: the place is taken, lies inside the source, or cannot be written.
        """
        check_place(source, root)
        self.source, self.repo_id, self.root = source, repo_id, root
        self._partial = root.with_name(f".{root.name}.partial")
        self.scenes = self._partial / "scenes"
        try:
            shutil.rmtree(self._partial, ignore_errors=True)
            (self._partial / "staged").mkdir(parents=True)
        except OSError as error:
            raise OutputError(
                f"{self._partial} cannot be written ({error.strerror}); choose another --new_root"
            ) from error

    def __enter__(self) -> "OutputDataset":
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._partial, ignore_errors=True)

    def stage(
        self, index: int, variant: int, frames: Iterable[Mapping[str, np.ndarray]], provenance: Provenance
    ) -> NewEpisode:
        """Encode the new pictures of one episode as they are drawn (see `stage_pictures`)."""
        folder = self._partial / "staged" / f"episode_{index:06d}_variant_{variant:02d}"
        pictures = stage_pictures(self.source, folder, frames, int(self.source.episodes[index]["length"]))
        return NewEpisode(index, provenance, pictures)

    def finish(self, episodes: list[NewEpisode], recipe_yaml: str) -> None:
        """Put the dataset together and move it to its place.

        Raises:
            EpisodeError: a file of the source cannot be copied.
            OutputError: the place was taken meanwhile.
        """
        folder = self._partial / "dataset"
        _Assembly(self.source, self.repo_id, folder).build(episodes)
        write_provenance(folder, [episode.provenance for episode in episodes], recipe_yaml)
        for number, episode in enumerate(episodes):
            if episode.masks:
                write_unseen(folder, number, episode.masks)
        if self.scenes.is_dir():
            self.scenes.rename(folder / saved.FOLDER)
        if self.root.exists():
            raise OutputError(f"{self.root} appeared while the dataset was made; it was left as it is")
        folder.rename(self.root)


def check_place(source: LeRobotDatasetMetadata, root: Path) -> None:
    """Whether a dataset can be written to `root`.

    Raises:
        OutputError: it exists already, or lies inside the source.
    """
    if root.resolve().is_relative_to(source.root.resolve()):
        raise OutputError(
            f"{root} lies inside the source {source.root}, which is never written to; choose another --new_root"
        )
    if root.exists():
        raise OutputError(f"{root} exists already; remove it or choose another --new_repo_id or --new_root")


class _Files:
    """Chunk and file indices of a growing series of files of bounded size."""

    def __init__(self, chunks_size: int) -> None:
        self._chunks_size = chunks_size
        self._next = (0, 0)

    def take(self) -> tuple[int, int]:
        taken = self._next
        self._next = update_chunk_file_indices(*taken, self._chunks_size)
        return taken


class _RowFiles:
    """The growing series of parquet files, one row group per episode, as LeRobot writes them."""

    def __init__(self, meta: LeRobotDatasetMetadata, folder: Path) -> None:
        self._meta, self._folder = meta, folder
        self._files = _Files(meta.chunks_size)
        self._writer: pq.ParquetWriter | None = None
        self._path, self._place = folder, (0, 0)

    def __enter__(self) -> "_RowFiles":
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def add(self, rows: pa.Table) -> tuple[int, int]:
        """Append an episode; returns the chunk and file index of where it went."""
        if self._writer is not None and self._path.stat().st_size > self._meta.data_files_size_in_mb * MEGABYTE:
            self._writer.close()
            self._writer = None
        if self._writer is None:
            self._place = self._files.take()
            chunk, file = self._place
            self._path = self._folder / self._meta.data_path.format(chunk_index=chunk, file_index=file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(self._path, rows.schema, compression="snappy", use_dictionary=True)
        self._writer.write_table(rows, row_group_size=rows.num_rows)
        return self._place


class _Assembly:
    """Builds the folder of a dataset from staged episodes."""

    def __init__(self, source: LeRobotDatasetMetadata, repo_id: str, folder: Path) -> None:
        self.source = source
        self.folder = folder
        self.meta = LeRobotDatasetMetadata.create(
            repo_id=repo_id,
            fps=source.fps,
            features=source.features,
            robot_type=source.robot_type,
            root=folder,
            use_videos=bool(source.video_keys),
            chunks_size=source.chunks_size,
            data_files_size_in_mb=source.data_files_size_in_mb,
            video_files_size_in_mb=source.video_files_size_in_mb,
        )
        self.meta.info.features = copy.deepcopy(source.features)
        self.meta.info.tools = copy.deepcopy(source.info.tools)
        self.meta.tasks = source.tasks.copy()
        write_info(self.meta.info, folder)
        write_tasks(self.meta.tasks, folder)

    def build(self, episodes: list[NewEpisode]) -> None:
        places: list[dict[str, Any]] = [{} for _ in episodes]
        for key in self.source.video_keys:
            self._place_videos(key, episodes, places)
        self._place_rows(episodes, places)
        self.meta.finalize()

    def _place_videos(self, key: str, episodes: list[NewEpisode], places: list[dict[str, Any]]) -> None:
        """Concatenate one camera's videos into files of bounded size; copies and renders never share a file."""
        files = _Files(self.meta.chunks_size)
        for rendered in (False, True):
            group: list[tuple[int, Path]] = []
            size = 0
            for i, episode in enumerate(episodes):
                if (key in episode.pictures.videos) != rendered:
                    continue
                path = episode.pictures.videos[key] if rendered else self._copied_video(key, episode.source_index)
                if group and size + path.stat().st_size > self.meta.video_files_size_in_mb * MEGABYTE:
                    self._write_video_file(key, group, files.take(), places)
                    group, size = [], 0
                group.append((i, path))
                size += path.stat().st_size
            if group:
                self._write_video_file(key, group, files.take(), places)

    def _copied_video(self, key: str, index: int) -> Path:
        path = self.folder.parent / "copied" / f"episode_{index:06d}" / f"{key}.mp4"
        if not path.exists():
            episode = self.source.episodes[index]
            cut_video(
                inside_root(self.source, self.source.get_video_file_path(index, key)),
                float(episode[f"videos/{key}/from_timestamp"]),
                int(episode["length"]),
                self.source.fps,
                encoder_of(self.source.features[key], key),
                path,
            )
        return path

    def _write_video_file(
        self, key: str, group: list[tuple[int, Path]], place: tuple[int, int], places: list[dict[str, Any]]
    ) -> None:
        chunk, file = place
        path = self.folder / str(self.meta.video_path).format(video_key=key, chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        if len(group) == 1:
            shutil.copyfile(group[0][1], path)
        else:
            concatenate_video_files([part for _, part in group], path)
        start = 0.0
        for i, part in group:
            end = start + get_video_duration_in_s(part)
            places[i] |= {
                f"videos/{key}/chunk_index": chunk,
                f"videos/{key}/file_index": file,
                f"videos/{key}/from_timestamp": start,
                f"videos/{key}/to_timestamp": end,
            }
            start = end

    def _place_rows(self, episodes: list[NewEpisode], places: list[dict[str, Any]]) -> None:
        start = 0
        copied_stats: dict[int, Stats] = {}
        with _RowFiles(self.meta, self.folder) as files:
            for i, episode in enumerate(episodes):
                rows = self._new_rows(episode, i, start)
                chunk, file = files.add(rows)
                if episode.source_index not in copied_stats:
                    copied_stats = {episode.source_index: self._copied_stats(episode.source_index)}
                stats = copied_stats[episode.source_index] | self._row_stats(rows) | episode.pictures.stats
                self.meta.save_episode(
                    i,
                    rows.num_rows,
                    list(self.source.episodes[episode.source_index]["tasks"]),
                    {key: stats[key] for key in self.source.features if key in stats},
                    {"data/chunk_index": chunk, "data/file_index": file} | places[i],
                )
                start += rows.num_rows

    def _new_rows(self, episode: NewEpisode, index: int, start: int) -> pa.Table:
        """The source's rows with new indices and, for re-rendered image features, new pictures."""
        rows = read_rows(self.source, episode.source_index)
        new_columns: dict[str, Any] = {
            "episode_index": [index] * rows.num_rows,
            "index": range(start, start + rows.num_rows),
        }
        for key, folder in episode.pictures.images.items():
            new_columns[key] = [{"bytes": path.read_bytes(), "path": path.name} for path in sorted(folder.iterdir())]
        for key, values in new_columns.items():
            position = rows.column_names.index(key)
            rows = rows.set_column(
                position, rows.schema.field(position), [pa.array(values, rows.schema.field(key).type)]
            )
        return rows

    def _row_stats(self, rows: pa.Table) -> Stats:
        """Statistics of the numeric columns, computed as LeRobot does when it records."""
        columns = {}
        for key, feature in self.source.features.items():
            if feature["dtype"] in ("video", "image", "string", "language") or key not in rows.column_names:
                continue
            columns[key] = np.stack([np.asarray(item) for item in rows[key].to_pylist()]).astype(feature["dtype"])
        return compute_episode_stats(columns, self.source.features)

    def _copied_stats(self, index: int) -> Stats:
        """Statistics of the source's own pictures, from sampled frames."""
        rows = read_rows(self.source, index)
        chosen = sample_indices(rows.num_rows)
        stats = {}
        for key in self.source.camera_keys:
            if key in self.source.depth_keys:
                depth, _ = read_depth(self.source, index, key, rows)
                samples, scale = depth[chosen][:, None].numpy() * depth_units_per_metre(self.source, key), 1.0
            else:
                samples = read_colour(self.source, index, key, rows)[chosen].permute(0, 3, 1, 2).numpy()
                scale = 255.0
            stats[key] = image_stats(np.stack([auto_downsample_height_width(sample) for sample in samples]), scale)
        return stats
