"""What the metadata of a dataset on this machine says of its episodes and cameras. Without LeRobot, as in `named`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_msdyn.dataset.checks import PICTURE_DTYPES, check_metadata, check_version, read_json
from lerobot_msdyn.dataset.features import DEPTH_FLAG, completed
from lerobot_msdyn.dataset.named import lerobot_home


@dataclass(frozen=True)
class Metadata:
    """Part of what LeRobot's `LeRobotDatasetMetadata` says, by the same names."""

    repo_id: str
    root: Path
    total_episodes: int
    features: dict[str, dict[str, Any]]
    robot_type: str | None

    @property
    def camera_keys(self) -> list[str]:
        """Feature keys of all cameras."""
        return [key for key, feature in self.features.items() if feature["dtype"] in PICTURE_DTYPES]

    @property
    def depth_keys(self) -> list[str]:
        """Those of them that record depth."""
        return [key for key in self.camera_keys if (self.features[key].get("info") or {}).get(DEPTH_FLAG)]


def described(repo_id: str, root: Path | None = None) -> Metadata | None:
    """The metadata of a dataset in `root`, else in LeRobot's home; None if it is in neither.

    Raises:
        DatasetError: it is not of version v3.0, or its metadata is not what it should be.
    """
    folder = lerobot_home() / repo_id if root is None else root
    if not (folder / "meta" / "info.json").exists():
        return None
    check_version(folder)
    count = check_metadata(folder).count
    info = read_json(folder, "meta/info.json")
    features = {key: completed(feature) for key, feature in info["features"].items()}
    return Metadata(repo_id, folder, count, features, info.get("robot_type"))
