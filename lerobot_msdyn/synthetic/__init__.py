"""Exact ray-cast toy scenes with ground truth: the demo's data, the tests' truth, a benchmark that anyone can run.

Each public name is imported when it is first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_msdyn.synthetic.choreography import KINDS, STATE_NAMES
    from lerobot_msdyn.synthetic.dataset import write_dataset
    from lerobot_msdyn.synthetic.iphone import write_iphone_folder
    from lerobot_msdyn.synthetic.nvs import covisibility, write_nvs_folder
    from lerobot_msdyn.synthetic.scene import Surface, SyntheticScene, SyntheticTracks, SyntheticView, make_scene
    from lerobot_msdyn.synthetic.viewpoints import heldout_cameras

_HOMES = {
    "KINDS": "choreography",
    "STATE_NAMES": "choreography",
    "Surface": "scene",
    "SyntheticScene": "scene",
    "SyntheticTracks": "scene",
    "SyntheticView": "scene",
    "covisibility": "nvs",
    "heldout_cameras": "viewpoints",
    "make_scene": "scene",
    "write_dataset": "dataset",
    "write_iphone_folder": "iphone",
    "write_nvs_folder": "nvs",
}
__all__ = [
    "KINDS",
    "STATE_NAMES",
    "Surface",
    "SyntheticScene",
    "SyntheticTracks",
    "SyntheticView",
    "covisibility",
    "heldout_cameras",
    "make_scene",
    "write_dataset",
    "write_iphone_folder",
    "write_nvs_folder",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
