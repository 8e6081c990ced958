"""Which pictures of a sequence are fitted and which validate (layout: `iphone`). Without torch."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_msdyn.core.errors import DatasetError


def read_split(root: Path, name: str) -> tuple[list[str], list[int]]:
    """Pictures of a split and their times; those of camera 0 in the order of time.

    Raises:
        DatasetError: a file is absent or not as expected.
    """
    own = not (root / "splits").is_dir() and (root / "dataset.json").is_file()
    content = _own_split(root, name) if own else read_json(root / "splits" / f"{name}.json")
    try:
        names, times = [str(each) for each in content["frame_names"]], [int(each) for each in content["time_ids"]]
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{root}/splits/{name}.json: expected frame_names and time_ids ({error})") from error
    if len(names) != len(times) or (name == "train" and not names):
        raise DatasetError(f"{root}/splits/{name}.json: has {len(names)} frame_names and {len(times)} time_ids")
    order = np.argsort(times, kind="stable").tolist() if name == "train" else range(len(names))
    return [names[i] for i in order], [times[i] for i in order]


def _own_split(root: Path, name: str) -> dict[str, list[Any]]:
    """What DyCheck's loader puts in splits/ where that is absent: camera 0 is fitted, the others validate."""
    pictures, described = read_json(root / "dataset.json"), read_json(root / "metadata.json")
    try:
        ids = [each for each in pictures["ids"] if (described[each]["camera_id"] == 0) == (name == "train")]
        return {"frame_names": ids, "time_ids": [described[each]["warp_id"] for each in ids]}
    except (KeyError, TypeError) as error:
        raise DatasetError(
            f"{root}: has no splits/, and dataset.json and metadata.json do not tell ids, camera_id and warp_id of its "
            f"pictures ({error})"
        ) from error


def read_json(path: Path) -> Any:
    """What one of the sequence's files holds.

    Raises:
        DatasetError: it cannot be read.
    """
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{path}: cannot be read ({error}); expected a DyCheck sequence, see docs/evaluate.md"
        ) from error
