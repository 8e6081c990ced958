"""Whether every picture of a dataset is the one of its row, and whether a trainer would take it (for `fuzz.py`)."""

import collections
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from faults import KEYS, Shown
from lerobot.datasets import LeRobotDataset
from lerobot.utils.feature_utils import dataset_to_policy_features
from marks import CAMERAS, read_turned, turns_of

RENDERED = 0  # the camera that is


def wrong_pictures(dataset: LeRobotDataset, source: Path, shown: Shown, *, whole: bool) -> list[str]:
    """What pictures of an output are not those of their rows.

    Args:
        dataset: the output.
        source: the folder of what it was made from.
        shown: the marks that each row may show.
        whole: whether new pictures were rendered, so that a mark may be lost; else they are upside down.
    """
    variants = pq.read_table(dataset.root / "meta" / "msdyn" / "episodes.parquet")["variant"].to_pylist()
    recorded = {key: _turns_of_source(source, key) for key in KEYS}
    found: collections.Counter[str] = collections.Counter()
    first: dict[str, str] = {}

    def count(kind: str, example: str) -> None:
        found[kind] += 1
        first.setdefault(kind, example)

    for number, variant in enumerate(variants):
        turned = {key: turns_of(dataset.root / dataset.meta.get_video_file_path(number, key)) for key in KEYS}
        start = int(dataset.meta.episodes[number]["dataset_from_index"])
        for row in range(int(dataset.meta.episodes[number]["length"])):
            item = dataset[start + row]
            episode, t = (int(value) for value in item["observation.state"][:2])
            where = f"episode {number} ({'copy' if variant < 0 else 'new'} of {episode}) row {row}"
            if (t, int(item["frame_index"])) != (row, row):
                count("row out of order", f"{where} has state {t} and frame_index {int(item['frame_index'])}")
            for camera, key in enumerate(KEYS):
                expected = shown[camera, episode][t]
                rendered = camera == RENDERED and variant >= 0
                image = np.rint(item[key].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
                mark, turns = read_turned(image[::-1] if rendered and not whole else image)
                by = (turned[key] - turns - recorded[key][episode]) % 4
                if not expected:
                    continue
                if mark is None and not (rendered and whole):
                    count("unreadable picture", f"{where}, {CAMERAS[camera]}")
                elif mark is not None and mark not in expected:
                    count("wrong picture", f"{where}, {CAMERAS[camera]} shows {mark}, expected {sorted(expected)}")
                elif mark is not None and by:
                    count("turned picture", f"{where}, {CAMERAS[camera]} is shown {90 * by} degrees from the source's")
    return [f"{total} x {kind}: {first[kind]}" for kind, total in found.items()]


def unfit_for_training(dataset: LeRobotDataset) -> list[str]:
    """What a trainer would fail at."""
    try:
        features = dataset_to_policy_features(dataset.meta.features)
    except (TypeError, ValueError, KeyError) as error:
        return [f"a trainer fails at the features: {type(error).__name__} {error}"]
    stats = dataset.meta.stats or {}
    lacking = [key for key in features if not {"mean", "std", "min", "max"} <= set(stats.get(key, {}))]
    return [f"a trainer lacks the statistics of {lacking}"] if lacking else []


def _turns_of_source(source: Path, key: str) -> list[int]:
    """The quarter turns that the matrix of each episode's recorded video asks for."""
    table = pq.read_table(source / "meta" / "episodes" / "chunk-000" / "file-000.parquet")  # others may be cut off
    files = table[f"videos/{key}/file_index"].to_pylist()
    paths = {number: source / "videos" / key / "chunk-000" / f"file-{number:03d}.mp4" for number in files}
    turns = {number: turns_of(path) if path.exists() else 0 for number, path in paths.items()}
    return [turns[number] for number in files]
