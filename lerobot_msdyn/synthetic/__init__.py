"""Exact ray-cast toy scenes with ground truth: the demo's data, the tests' truth, a benchmark that anyone can run."""

from lerobot_msdyn.synthetic.choreography import KINDS, STATE_NAMES
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.synthetic.iphone import write_iphone_folder
from lerobot_msdyn.synthetic.nvs import covisibility, write_nvs_folder
from lerobot_msdyn.synthetic.scene import Surface, SyntheticScene, SyntheticTracks, SyntheticView, make_scene
from lerobot_msdyn.synthetic.viewpoints import heldout_cameras

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
