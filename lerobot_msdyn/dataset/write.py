"""Write a new LeRobot dataset: the source's rows bit for bit, its other cameras copied, new pictures encoded alike.

Everything is prepared in a hidden folder beside the output (see `staging`), which appears by one rename when it is
complete.
"""

import copy
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import compute_episode_stats
from lerobot.datasets.io_utils import write_info, write_stats, write_tasks
from lerobot.datasets.utils import update_chunk_file_indices
from lerobot.datasets.video_utils import concatenate_video_files

from lerobot_msdyn.core.errors import OutputError, first_line
from lerobot_msdyn.core.files import DISK_FAULTS, temporary_files_in, writing
from lerobot_msdyn.dataset.card import licence_of, write_card
from lerobot_msdyn.dataset.checks import MAX_NAME, PICTURE_DTYPES, TEXT_DTYPES
from lerobot_msdyn.dataset.copy_source import stage_copies
from lerobot_msdyn.dataset.encode import StagedPictures, Stats, check_encoding, stage_pictures
from lerobot_msdyn.dataset.provenance import Provenance, write_provenance, write_unseen
from lerobot_msdyn.dataset.rows import KEPT_S, TIMESTAMP_TOLERANCE_S, off_grid_s, on_grid, read_rows, values_of
from lerobot_msdyn.dataset.staging import FINISHED, SCENE, Kept, Staging
from lerobot_msdyn.dataset.video import frame_times
from lerobot_msdyn.dataset.video_index import index_of
from lerobot_msdyn.scene import store

MEGABYTE = 1024**2
ROWS_IN_GROUP = 100  # of a parquet file, at least: each group takes 6 kB of memory until the file is closed
METADATA_AT_ONCE = 200  # episodes: each group of them takes memory for its statistics until the file is closed


@dataclass(frozen=True)
class NewEpisode:
    """One episode of the output: a source episode with some cameras' pictures replaced."""

    source_index: int
    provenance: Provenance
    pictures: StagedPictures = field(default_factory=StagedPictures)  # none for a copy of the source's episode
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)  # whose values are others: poses of new cameras
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)  # of what was never seen, see `write_unseen`
    dropped: str = ""  # why there is no such episode in the end: the gate's reason
    # For the report: what took how long; and pictures by camera: of the priors, and a frame of what was dropped.
    seconds: Mapping[str, float] = field(default_factory=dict)
    sheets: Mapping[str, Path] = field(default_factory=dict)
    frames: Mapping[str, Path] = field(default_factory=dict)


class MadeEpisodes(Sequence):
    """New episodes that are finished, read from the work folder as they are asked for: there may be thousands.

    A `Sequence[NewEpisode]`, which is not said above: where annotations are checked, as in tests, one would be read
    to see what it is, when the work folder may be gone.
    """

    def __init__(self, output: "OutputDataset", places: Sequence[tuple[int, int]]) -> None:
        """Describe them.

        Args:
            output: the dataset that they are made for.
            places: of each its source episode, and its number among the new ones of that.
        """
        self._output, self._places = output, places
        self._read: tuple[int, list[NewEpisode]] = (-1, [])

    @staticmethod
    def of(output: "OutputDataset", episodes: Iterable[int]) -> tuple["MadeEpisodes", "MadeEpisodes"]:
        """All new episodes of some source episodes; and those of them that are not dropped.

        Raises:
            OutputError: one is not finished after all.
        """
        made, kept = [], []
        for index in episodes:
            for number, new in enumerate(output.finished_episode(index)):
                made.append((index, number))
                if not new.dropped:
                    kept.append((index, number))
        return MadeEpisodes(output, made), MadeEpisodes(output, kept)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return MadeEpisodes(self._output, self._places[place])
        index, number = self._places[place]
        if self._read[0] != index:  # the new episodes of one recording follow each other
            self._read = index, self._output.finished_episode(index)
        return self._read[1][number]


class OutputDataset:
    """A dataset in the making. Use as a context; what is finished is kept for the next run, until the dataset is."""

    def __init__(
        self,
        source: LeRobotDatasetMetadata,
        repo_id: str,
        root: Path,
        staging: Staging | None = None,
        *,
        nvenc: bool = False,
        replaces: bool = False,
    ) -> None:
        """Prepare the work folder.

        Args:
            source: the dataset whose episodes are re-rendered.
            repo_id: the new dataset's name.
            root: its place.
            staging: a work folder that may hold what an earlier run finished; default: an empty one.
            nvenc: whether a GPU encodes the new videos where it can.
            replaces: whether what lies in the place is an older state of this output, which the new one replaces.

        Raises:
            OutputError: the place is taken, lies inside the source, is being written by another run, or cannot be.
        """
        if not replaces:
            check_place(source.root, root)
        self.replaces = replaces
        self.source, self.repo_id, self.root, self.nvenc = source, repo_id, root, nvenc
        self._resumable = staging is not None
        self.staging = staging or Staging(root)
        if staging is None:
            self.staging.clear()
        self.scenes = self.staging.folder / "scenes"

    def __enter__(self) -> "OutputDataset":
        return self

    def __exit__(self, *_: object) -> None:
        if not self._resumable:  # else the staging's owner closes it
            self.staging.remove()
            self.staging.close()

    def episode(self, index: int) -> Kept:
        """What is kept of one source episode: `keep` computes a value once, whatever number of runs it takes."""
        return self.staging.episode(index)

    def stage(
        self, index: int, variant: int, frames: Iterable[Mapping[str, np.ndarray]], provenance: Provenance
    ) -> NewEpisode:
        """Encode the new pictures of one episode as they are rendered (see `stage_pictures`)."""
        folder = self.episode(index).folder / f"variant_{variant:02d}"
        length = int(self.source.episodes[index]["length"])
        pictures = stage_pictures(self.source, folder, frames, length, nvenc=self.nvenc)
        return NewEpisode(index, provenance, pictures)

    def check(self, cameras: Sequence[str], *, depth: bool) -> None:
        """Whether what will be made can be written: by a few frames of every new video, before any work.

        Args:
            cameras: those that are re-rendered.
            depth: whether their recorded depth is as well.

        Raises:
            OutputError: a video cannot be encoded as the source's, or LeRobot refuses the features.
        """
        folder = self.staging.folder / "check"
        keys = [*cameras, *(f"{key}_depth" for key in cameras if depth and f"{key}_depth" in self.source.depth_keys)]
        with writing(folder):
            shutil.rmtree(folder, ignore_errors=True)
            check_encoding(self.source, keys, folder / "videos", nvenc=self.nvenc)
            try:
                _Assembly(self.source, self.repo_id, folder / "dataset", self.copies)
            except (ValueError, TypeError, KeyError) as error:
                raise OutputError(
                    f"{self.source.root}: LeRobot cannot make a dataset of the same features ({first_line(error)})"
                ) from error
            shutil.rmtree(folder)

    def is_finished(self, index: int) -> bool:
        """Whether all new episodes of one source episode are made."""
        return self.episode(index).has(FINISHED)

    def finish_episode(self, index: int, make: Callable[[], list[NewEpisode]]) -> list[NewEpisode]:
        """All new episodes of one source episode, made once; what the source has to offer is copied and checked first.

        Raises:
            EpisodeError: a file of the episode is absent or damaged.
            OutputError: the disk is full.
        """
        kept = self.episode(index)

        def complete() -> list[NewEpisode]:
            self.copies(index)
            return make()

        with kept.locked():  # another process may work for the same output
            new: list[NewEpisode] = kept.keep(FINISHED, complete)
            kept.forget(SCENE)
            kept.say_failed("")
        return new

    def finished_episode(self, index: int) -> list[NewEpisode]:
        """The new episodes of one that is finished.

        Raises:
            OutputError: what was kept of them is damaged; it is removed, so that the same command makes them again.
        """
        new: list[NewEpisode] = self.episode(index).kept_value(FINISHED)
        return new

    def copies(self, index: int) -> StagedPictures:
        """The source's pictures of one episode, cut out and checked."""
        kept = self.episode(index)

        def make() -> StagedPictures:
            with writing(kept.folder):
                return stage_copies(self.source, index, self.source.camera_keys, kept.folder / "copied")

        pictures: StagedPictures = kept.keep("copied", make)
        return pictures

    def finish(
        self,
        episodes: list[NewEpisode] | MadeEpisodes,
        recipe_yaml: str,
        skipped: Sequence[str] = (),
        report: Callable[[Path], object] = lambda folder: None,
        *,
        keep: bool = False,
    ) -> None:
        """Put the dataset together, read it again, and move it to its place.

        Args:
            episodes: what it consists of, in order.
            recipe_yaml: the settings that it was made with.
            skipped: one line per source or new episode that is not in it.
            report: called with the folder of the complete dataset, before it is moved.
            keep: whether the work folder stays, for a run that makes what is skipped here.

        Raises:
            EpisodeError: a file of the source cannot be copied.
            OutputError: the place was taken meanwhile, the disk is full, or what was written cannot be read.
        """
        folder = self.staging.folder / "dataset"
        with writing(folder), temporary_files_in(self.staging.folder):
            shutil.rmtree(folder, ignore_errors=True)
            off_s = _Assembly(self.source, self.repo_id, folder, self.copies).build(episodes)
            provenance = (
                replace(episode.provenance, times_replaced_s=off if off > KEPT_S else 0.0)
                for episode, off in zip(episodes, off_s, strict=True)
            )
            write_provenance(folder, provenance, recipe_yaml, self.staging.run_digest())
            for number, episode in enumerate(episodes):
                if episode.masks:
                    write_unseen(folder, number, episode.masks)
            if self.scenes.is_dir():
                shutil.copytree(self.scenes, folder / store.FOLDER, copy_function=os.link)
            report(folder)
            write_card(folder, self.repo_id, licence_of(self.source.root))
            if self.root.exists() and not self.replaces:
                raise OutputError(f"{self.root} appeared while the dataset was made; it was left as it is")
            self.staging.publish(folder, self.root, skipped, keep=keep)


def check_name(repo_id: str) -> None:
    """Whether a dataset can have this name, which becomes a folder's.

    Raises:
        OutputError: it cannot.
    """
    parts = repo_id.split("/")
    wrong = any(part.strip(".") == "" or len(part) > MAX_NAME or not part.isprintable() for part in parts)
    if wrong or len(parts) > 2 or "\\" in repo_id:
        raise OutputError(f"new_repo_id is {repo_id!r}; expected a name as local/desk (--new_repo_id)")


def check_place(source_root: Path, root: Path) -> None:
    """Whether a dataset can be written to `root`.

    Raises:
        OutputError: it exists already, lies inside the source, or cannot be looked at.
    """
    try:
        exists = root.exists()
    except OSError as error:
        raise OutputError(f"{root} cannot be looked at ({error.strerror}); choose another --new_root") from error
    if root.resolve().is_relative_to(source_root.resolve()):
        raise OutputError(
            f"{root} lies inside the source {source_root}, which is never written to; choose another --new_root"
        )
    if exists:
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
    """The growing series of parquet files: a row group per episode, as LeRobot writes them, or several short ones."""

    def __init__(self, meta: LeRobotDatasetMetadata, folder: Path) -> None:
        self._meta, self._folder = meta, folder
        self._files = _Files(meta.chunks_size)
        self._writer: pq.ParquetWriter | None = None
        self._path, self._place = folder, (0, 0)
        self._group: list[pa.Table] = []

    def __enter__(self) -> "_RowFiles":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def add(self, rows: pa.Table) -> tuple[int, int]:
        """Append an episode; returns the chunk and file index of where it goes."""
        if self._writer is not None:
            full = self._path.stat().st_size > self._meta.data_files_size_in_mb * MEGABYTE
            if full or not rows.schema.equals(self._writer.schema):  # the source's files may differ in their types
                self._close()
        if self._writer is None:
            self._place = self._files.take()
            chunk, file = self._place
            self._path = self._folder / self._meta.data_path.format(chunk_index=chunk, file_index=file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(self._path, rows.schema, compression="snappy", use_dictionary=True)
        self._group.append(rows)
        if sum(part.num_rows for part in self._group) >= ROWS_IN_GROUP:
            self._write_group()
        return self._place

    def _write_group(self) -> None:
        if self._writer is not None and self._group:
            rows = pa.concat_tables(self._group)
            self._writer.write_table(rows, row_group_size=rows.num_rows)
            self._group = []

    def _close(self) -> None:
        self._write_group()
        if self._writer is not None:
            self._writer.close()
            self._writer = None


class _Assembly:
    """Builds the folder of a dataset from staged episodes."""

    def __init__(
        self,
        source: LeRobotDatasetMetadata,
        repo_id: str,
        folder: Path,
        copies: Callable[[int], StagedPictures],
    ) -> None:
        self.source = source
        self.copies = copies
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
            metadata_buffer_size=METADATA_AT_ONCE,
        )
        self.meta.info.features = copy.deepcopy(source.features)
        self.meta.info.tools = copy.deepcopy(source.info.tools)
        self.meta.tasks = source.tasks.copy()
        write_info(self.meta.info, folder)
        write_tasks(self.meta.tasks, folder)

    def build(self, episodes: Sequence[NewEpisode]) -> list[float]:
        """Write all of them; returns how far (s) the recorded times of each were off frame_index / fps."""
        places: list[dict[str, Any]] = [{} for _ in episodes]
        for key in self.source.video_keys:
            self._place_videos(key, episodes, places)
        off_s = self._place_rows(episodes, places)
        self.meta.finalize()
        # LeRobot lists features in the order of a set, which is another in every process.
        write_stats(dict(sorted((self.meta.stats or {}).items())), self.folder)
        return off_s

    def _place_videos(self, key: str, episodes: Sequence[NewEpisode], places: list[dict[str, Any]]) -> None:
        """Concatenate one camera's videos into files of bounded size.

        Copies and renders never share a file, nor do videos of which one cannot follow the other without being encoded
        again: a source may have several codecs and pixel formats.
        """
        files = _Files(self.meta.chunks_size)
        groups: dict[Any, list[tuple[int, Path]]] = {}
        for i, episode in enumerate(episodes):
            rendered = key in episode.pictures.videos
            path = (episode.pictures if rendered else self.copies(episode.source_index)).videos[key]
            groups.setdefault((rendered, index_of(path).coding), []).append((i, path))
        for _, alike in sorted(groups.items(), key=lambda item: item[0][0]):
            group: list[tuple[int, Path]] = []
            size = 0
            for i, path in alike:
                if group and size + path.stat().st_size > self.meta.video_files_size_in_mb * MEGABYTE:
                    self._write_videos(key, group, files, places)
                    group, size = [], 0
                group.append((i, path))
                size += path.stat().st_size
            self._write_videos(key, group, files, places)

    def _write_videos(
        self, key: str, group: list[tuple[int, Path]], files: "_Files", places: list[dict[str, Any]]
    ) -> None:
        """One file of several videos, or one for each where they cannot be put together."""
        place = files.take()
        if not self._write_video_file(key, group, place, places):
            for part, own in zip(group, [place, *(files.take() for _ in group[1:])], strict=True):
                self._write_video_file(key, [part], own, places)

    def _write_video_file(
        self, key: str, group: list[tuple[int, Path]], place: tuple[int, int], places: list[dict[str, Any]]
    ) -> bool:
        """Whether the frames of the file that was written follow each other evenly."""
        chunk, file = place
        path = self.folder / str(self.meta.video_path).format(video_key=key, chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        if len(group) == 1:
            shutil.copyfile(group[0][1], path)
        else:
            try:
                concatenate_video_files([part for _, part in group], path)
            except (av.FFmpegError, ValueError) as error:
                if isinstance(error, OSError) and error.errno in DISK_FAULTS:
                    raise
                return False
        lengths = [len(frame_times(part)) for _, part in group]
        if len(group) > 1 and not _is_even(path, sum(lengths), self.meta.fps):
            return False
        count = 0
        for (i, _), length in zip(group, lengths, strict=True):
            start, end = count / self.meta.fps, (count + length) / self.meta.fps
            places[i] |= {
                f"videos/{key}/chunk_index": chunk,
                f"videos/{key}/file_index": file,
                f"videos/{key}/from_timestamp": start,
                f"videos/{key}/to_timestamp": end,
            }
            count += length
        return True

    def _place_rows(self, episodes: Sequence[NewEpisode], places: list[dict[str, Any]]) -> list[float]:
        start, off_s = 0, []
        read: tuple[int, pa.Table] | None = None  # the episodes of one recording follow each other
        with _RowFiles(self.meta, self.folder) as files:
            for i, episode in enumerate(episodes):
                if read is None or read[0] != episode.source_index:
                    read = episode.source_index, read_rows(self.source, episode.source_index)
                off_s.append(off_grid_s(read[1], self.source.fps))
                rows = self._new_rows(episode, read[1], i, start)
                chunk, file = files.add(rows)
                stats = self.copies(episode.source_index).stats | self._row_stats(rows) | episode.pictures.stats
                self.meta.save_episode(
                    i,
                    rows.num_rows,
                    list(self.source.episodes[episode.source_index]["tasks"]),
                    {key: stats[key] for key in self.source.features if key in stats},
                    {"data/chunk_index": chunk, "data/file_index": file} | places[i],
                )
                start += rows.num_rows
        return off_s

    def _new_rows(self, episode: NewEpisode, recorded: pa.Table, index: int, start: int) -> pa.Table:
        """The source's rows with new indices and, for re-rendered features, new pictures and poses of the camera."""
        rows = on_grid(recorded, self.source.fps)
        new_columns: dict[str, Any] = {
            "episode_index": [index] * rows.num_rows,
            "index": range(start, start + rows.num_rows),
        }
        for key, folder in episode.pictures.images.items():
            new_columns[key] = [{"bytes": path.read_bytes(), "path": path.name} for path in sorted(folder.iterdir())]
        new_columns |= {key: values.tolist() for key, values in episode.columns.items()}
        for key, values in new_columns.items():
            position = rows.column_names.index(key)
            rows = rows.set_column(
                position, rows.schema.field(position), [pa.array(values, rows.schema.field(key).type)]
            )
        return rows

    def _row_stats(self, rows: pa.Table) -> Stats:
        """Statistics of the numeric columns, computed as LeRobot does when it records."""
        columns = {
            key: values_of(rows, key, feature)
            for key, feature in self.source.features.items()
            if feature["dtype"] not in PICTURE_DTYPES + TEXT_DTYPES
        }
        # LeRobot's are per last axis where there are several, except for a single row: made alike, so that they add up.
        nested = [key for key, values in columns.items() if values.ndim > 2]
        columns |= {key: columns[key].reshape(-1, columns[key].shape[-1]) for key in nested}
        stats: Stats = compute_episode_stats(columns, self.source.features)
        for key in nested:
            stats[key]["count"] = np.array([rows.num_rows])
        return stats


def _is_even(path: Path, frames: int, fps: int | float) -> bool:
    """Whether a file that was put together has so many frames, the i-th at i / fps."""
    times = frame_times(path)
    late = max((abs(float(time) - i / fps) for i, time in enumerate(times)), default=0.0)
    return len(times) == frames and late < TIMESTAMP_TOLERANCE_S
