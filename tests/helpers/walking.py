"""A camera that goes to and fro before a desk on which a block is pushed, with all that is true of it."""

import torch

from lerobot_msdyn.core.observations import DepthTraits, PointTracks, Priors, View
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.scene import SyntheticScene
from lerobot_msdyn.synthetic.viewpoints import hand_held_camera

FRAMES, WIDTH, HEIGHT = 12, 96, 72
SWAY_DEG = 10.0


def walk() -> tuple[SyntheticScene, View, Priors]:
    """The scene, its video and true priors."""
    scene = make_scene("push", 0, FRAMES, WIDTH, HEIGHT)
    camera = hand_held_camera(FRAMES, WIDTH, HEIGHT, SWAY_DEG)
    seen = scene.render(camera)
    nothing = torch.zeros(0, FRAMES)
    tracks = PointTracks(torch.zeros(0, FRAMES, 2), nothing.bool(), nothing, torch.zeros(0, dtype=torch.long))
    return scene, View(seen.rgb, camera), Priors(seen.depth, seen.instances, tracks, DepthTraits(metric=True))
