"""A camera that goes to and fro before a desk on which a block is pushed, with all that is true of it."""

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import DepthTraits, PointTracks, Priors, View
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.scene import SyntheticScene
from lerobot_msdyn.synthetic.viewpoints import hand_held_camera, walking_camera

FRAMES, WIDTH, HEIGHT = 12, 96, 72
SWAY_DEG = 10.0


def walk_along(
    azimuth_deg: tuple[float, float], seed: int = 0, episode: int = 0, world: str = "desk"
) -> tuple[SyntheticScene, View, Priors]:
    """A scene before a camera that goes along an arc, its video and true priors."""
    camera = walking_camera(FRAMES, WIDTH, HEIGHT, azimuth_deg, world)
    return _recorded(make_scene("push", seed, FRAMES, WIDTH, HEIGHT, episode=episode), camera)


def walk() -> tuple[SyntheticScene, View, Priors]:
    """The scene, its video and true priors."""
    camera = hand_held_camera(FRAMES, WIDTH, HEIGHT, SWAY_DEG)
    return _recorded(make_scene("push", 0, FRAMES, WIDTH, HEIGHT), camera)


def _recorded(scene: SyntheticScene, camera: CameraTrack) -> tuple[SyntheticScene, View, Priors]:
    seen = scene.render(camera)
    priors = Priors(seen.depth, seen.instances, PointTracks.none(FRAMES), DepthTraits(metric=True))
    return scene, View(seen.rgb, camera), priors
