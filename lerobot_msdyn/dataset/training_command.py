"""The command that trains on an output as it is."""

import json
import shlex
from pathlib import Path

from lerobot.configs.types import FeatureType
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.feature_utils import dataset_to_policy_features


def training_command(meta: LeRobotDatasetMetadata, recordings: int, repo_id: str, root: Path) -> str:
    """`lerobot-train` for a dataset that was made of some recordings, to be pasted into a shell.

    Where there are several recordings, whole ones are held out (`split`). Where depth is recorded, the policy is told
    which features to take: ACT and others refuse depth.
    """
    split = f"$(python -m lerobot_msdyn.split --root {shlex.quote(str(root))}) " if recordings > 1 else ""
    words = [
        f"--dataset.repo_id={repo_id}",
        f"--dataset.root={root}",
        "--policy.type=act",
        "--policy.push_to_hub=false",
    ]
    if meta.depth_keys:
        features = {
            key: {"type": feature.type.name, "shape": list(feature.shape)}
            for key, feature in dataset_to_policy_features(meta.features).items()
            if feature.type is not FeatureType.ACTION and key not in meta.depth_keys
        }
        words.append(f"--policy.input_features={json.dumps(features)}")
    return f"lerobot-train {split}{shlex.join(words)}"
