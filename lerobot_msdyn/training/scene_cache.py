"""The scenes that were used last, within a bound of memory."""

import threading
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_msdyn.scene.store import SavedScene, load
from lerobot_msdyn.training.live import LiveScene

MEGABYTE = 1024**2
Scenes = Mapping[int, Mapping[str, Path | SavedScene]]  # source episode -> camera -> its scene, or where it lies


class SceneCache:
    """Scenes ready to be rendered; those used longest ago are given up first. Every process has its own."""

    def __init__(self, scenes: Scenes, memory_mb: float) -> None:
        """Nothing is loaded yet; the scene in use is kept even where it alone is above the bound."""
        self.scenes, self.memory_mb = scenes, memory_mb
        self._live: OrderedDict[tuple[int, str], LiveScene] = OrderedDict()
        self._turn = threading.Lock()  # of threads that ask for scenes

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process loads its own."""
        return SceneCache, (self.scenes, self.memory_mb)

    @property
    def size_in_bytes(self) -> int:
        """Memory of what is loaded."""
        return sum(scene.size_in_bytes for scene in self._live.values())

    def get(self, episode: int, camera: str) -> LiveScene:
        """The scene of one camera of an episode, loaded if need be."""
        place = (episode, camera)
        with self._turn:
            if place not in self._live:
                scene = self.scenes[episode][camera]
                self._live[place] = LiveScene(load(scene) if isinstance(scene, Path) else scene)
                while len(self._live) > 1 and self.size_in_bytes > self.memory_mb * MEGABYTE:
                    self._live.popitem(last=False)
            self._live.move_to_end(place)
            return self._live[place]
