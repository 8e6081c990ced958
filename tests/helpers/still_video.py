"""A video in which nothing happens, and a scene that does not show it yet."""

import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.motion.model.bases import identity_level
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.reconstruction.background import background_gaussians
from lerobot_msdyn.scene.dynamic import DynamicScene

WIDTH, HEIGHT, FRAMES = 32, 24, 3


def still_video() -> tuple[View, Priors]:
    """A checkered wall 1 m away, three times the same frame."""
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    checks = (60 + 130 * ((x // 8 + y // 8) % 2)).to(torch.uint8)
    rgb = checks[None, ..., None].expand(FRAMES, -1, -1, 3).contiguous()
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    nothing = PointTracks(
        torch.zeros(0, FRAMES, 2),
        torch.zeros(0, FRAMES, dtype=torch.bool),
        torch.zeros(0, FRAMES),
        torch.zeros(0, dtype=torch.long),
    )
    instances = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    return View(rgb, camera), Priors(torch.ones(FRAMES, HEIGHT, WIDTH), instances, nothing, DepthTraits(metric=True))


def grey_scene(view: View) -> DynamicScene:
    """The right shapes in the wrong colour."""
    grey = torch.full((HEIGHT, WIDTH, 3), 128, dtype=torch.uint8)
    static = background_gaussians(grey, torch.ones(HEIGHT, WIDTH), view.camera, 10_000)
    none = static.select(torch.zeros(0, dtype=torch.long))
    level = identity_level(torch.zeros(1, 3), FRAMES)
    return DynamicScene(static, none, (level,), (torch.zeros(0, 1, dtype=torch.long),), (torch.zeros(0, 1),), FRAMES)
