"""Which episodes are whose."""

from collections.abc import Sequence

from lerobot_msdyn.augment.job import Opened


def shard(frames: Sequence[int], rank: int, world_size: int) -> list[int]:
    """Places of the episodes of one task: neighbours, and as many frames as each other task has, up to one episode.

    Neighbours, because they lie in the same files.

    Args:
        frames: of each episode, that are work.
        rank: number of the task.
        world_size: how many tasks there are.
    """
    total, before, mine = sum(frames), 0, []
    for place, count in enumerate(frames):
        middle = before + 0.5 * count
        if min(int(middle * world_size / max(total, 1)), world_size - 1) == rank:
            mine.append(place)
        before += count
    return mine


def shards(frames: Sequence[int], world_size: int) -> list[list[int]]:
    """The places of all tasks' episodes."""
    return [shard(frames, rank, world_size) for rank in range(world_size)]


def frames_to_render(opened: Opened) -> list[int]:
    """The frames of each episode; 0 where it is written as recorded, which is hardly any work."""
    rendered = set(opened.rendered)
    return [int(opened.source.episodes[index]["length"]) * (index in rendered) for index in opened.episodes]
