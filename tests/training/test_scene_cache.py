"""The memory that loaded scenes may take."""

import pickle
from pathlib import Path

from lerobot_msdyn.scene import store as saved
from lerobot_msdyn.training.scene_cache import MEGABYTE, SceneCache, Scenes

FRONT = "observation.images.front"


def test_the_scene_used_longest_ago_is_given_up(desk_scenes: Path) -> None:
    folders = saved.list_scenes(desk_scenes)
    scenes: Scenes = {0: folders[0], 1: folders[1], 2: {FRONT: saved.load(folders[0][FRONT])}}
    size = SceneCache(scenes, 1000.0).get(0, FRONT).size_in_bytes
    cache = SceneCache(scenes, 2.5 * size / MEGABYTE)
    first, second = cache.get(0, FRONT), cache.get(1, FRONT)
    assert cache.get(0, FRONT) is first
    cache.get(2, FRONT)
    assert cache.size_in_bytes <= 2.5 * size
    assert cache.get(0, FRONT) is first
    assert cache.get(1, FRONT) is not second
    tiny = SceneCache(scenes, 0.0)
    assert tiny.get(0, FRONT) is tiny.get(0, FRONT), "the one in use stays"
    assert pickle.loads(pickle.dumps(cache)).size_in_bytes == 0
