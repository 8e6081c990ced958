"""Every episode is one task's, and tasks have as many frames as each other."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_msdyn.cluster.shards import shards


@given(st.lists(st.integers(1, 2000), max_size=60), st.integers(1, 12))
def test_all_episodes_once_in_order_and_balanced(frames: list[int], world_size: int) -> None:
    parts = shards(frames, world_size)
    assert len(parts) == world_size
    assert [place for part in parts for place in part] == list(range(len(frames)))
    fair = sum(frames) / world_size
    for part in parts:
        assert abs(sum(frames[place] for place in part) - fair) <= max(frames, default=0)


@pytest.mark.parametrize("world_size", [1, 3])
def test_empty_episodes(world_size: int) -> None:
    assert sum(map(len, shards([0, 0], world_size))) == 2
