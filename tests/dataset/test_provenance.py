"""What is written beside the episodes comes back."""

from pathlib import Path

import numpy as np
import pytest

from lerobot_msdyn.core.errors import OutputError
from lerobot_msdyn.dataset.provenance import read_unseen, write_unseen
from lerobot_msdyn.views.pictures import Picture, UnseenMasks


def test_masks_of_what_was_never_seen_come_back(tmp_path: Path) -> None:
    unseen = np.random.default_rng(0).random((3, 5, 13)) < 0.5  # a width that is no multiple of eight
    rgb, depth = np.zeros((5, 13, 3), np.uint8), np.zeros((5, 13), np.float32)
    masks, key = UnseenMasks(), "observation.images.front"
    pictures = list(masks.kept(key, (Picture(rgb, depth, mask) for mask in unseen)))
    assert len(pictures) == 3
    write_unseen(tmp_path, 12, masks.arrays())
    (path,) = tmp_path.rglob("*.npz")
    assert path.name == "episode_000012.npz"
    assert np.array_equal(read_unseen(path, key), unseen)
    with pytest.raises(OutputError, match="no masks of 'other' there"):
        read_unseen(path, "other")
