"""A small scene in double precision: a wall, and two cards before it that move, each by a basis of its own."""

from dataclasses import fields, replace

import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, project, se3
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.motion.model.bases import MotionLevel, level_from_motions
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.reconstruction.loss_terms import FitStep, Targets
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians, gaussians_from_points
from lerobot_msdyn.scene.rendering import render_scene

WIDTH, HEIGHT, FRAMES = 24, 18, 4
WALL_M, CARDS_M = 2.0, 1.0


def moving_cards(*, part_alone: bool = False) -> DynamicScene:
    """Gaussians that follow both bases; or `part_alone`, each that of its card."""
    generator = torch.Generator().manual_seed(3)
    wall = _grid(12, 9, (2.4, 1.8), (0.0, 0.0), WALL_M, 0.11, generator)
    cards = [_grid(4, 4, (0.3, 0.3), (x, 0.02), CARDS_M, 0.06, generator) for x in (-0.22, 0.2)]
    moving = Gaussians(*(torch.cat([getattr(card, item.name) for card in cards]) for item in fields(Gaussians)))
    motions = torch.eye(4).repeat(2, FRAMES, 1, 1)
    for t in range(1, FRAMES):
        motions[0, t] = se3(axis_angle_to_matrix(torch.tensor([0.0, 0.0, 0.09 * t])), torch.tensor([0.02 * t, 0.01, 0]))
        motions[1, t, 1, 3] = 0.03 * t
    level = level_from_motions(motions.double(), torch.tensor([[-0.22, 0.0, CARDS_M], [0.2, 0.0, CARDS_M]]).double())
    part = torch.arange(2).repeat_interleave(16)
    index, logit = torch.stack((part, 1 - part), 1), torch.randn(32, 2, generator=generator).double() * 0.5
    if part_alone:
        index, logit = index[:, :1], logit[:, :1]
    return DynamicScene(wall, moving, (level,), (index,), (logit,), FRAMES)


def targets_of(scene: DynamicScene) -> Targets:
    """What a camera recorded that differs from the scene in colour, masks and depth, but not in its tracks."""
    generator = torch.Generator().manual_seed(5)
    intrinsics = intrinsics_from_fov(WIDTH, HEIGHT, 60.0).double().expand(FRAMES, 3, 3).contiguous()
    camera = CameraTrack(intrinsics, torch.eye(4).double().expand(FRAMES, 4, 4).contiguous(), WIDTH, HEIGHT)
    seen = render_scene(scene, camera, torch.arange(FRAMES), "reference")
    rgb = torch.randint(0, 256, (FRAMES, HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
    moves = torch.rand(FRAMES, HEIGHT, WIDTH, generator=generator) < 0.4
    depth = seen.depth * (1 + 0.1 * torch.rand(seen.depth.shape, generator=generator).double())
    means = scene.positions(torch.arange(FRAMES))[:, len(scene.static) :]
    xy = project(means, intrinsics)[0].transpose(0, 1)
    count = xy.shape[0]
    tracks = PointTracks(
        xy,
        torch.ones(count, FRAMES, dtype=torch.bool),
        0.5 + 0.5 * torch.rand(count, FRAMES, generator=generator).double(),
        torch.ones(count, dtype=torch.long),
    )
    priors = Priors(depth, moves.to(torch.uint8), tracks)
    return Targets(View(rgb, camera), priors, moves, torch.ones_like(moves), 1.0)


def in_single(scene: DynamicScene) -> DynamicScene:
    """The same in the precision of a fit."""
    level = scene.levels[0]
    assert isinstance(level, MotionLevel)
    floats = ("rotations_6d", "displacements", "knots", "pivots", "reach")
    static, moving = (
        Gaussians(**{item.name: getattr(part, item.name).float() for item in fields(part)})
        for part in (scene.static, scene.moving)
    )
    level = replace(level, **{name: getattr(level, name).float() for name in floats})
    logits = tuple(logit.float() for logit in scene.logits)
    return replace(scene, static=static, moving=moving, levels=(level,), logits=logits)


def recorded_in_single(scene: DynamicScene) -> tuple[View, Priors]:
    """What `targets_of` has, in the precision of a fit."""
    targets = targets_of(scene)
    camera, priors = targets.view.camera, targets.priors
    camera = replace(camera, intrinsics=camera.intrinsics.float(), world_from_camera=camera.world_from_camera.float())
    tracks = replace(priors.tracks, xy=priors.tracks.xy.float(), confidence=priors.tracks.confidence.float())
    return View(targets.view.rgb, camera), replace(priors, depth=priors.depth.float(), tracks=tracks)


def at_frame(scene: DynamicScene, frame: int, targets: Targets) -> FitStep:
    """One step of a fit, as the plain rasterizer draws it."""
    frames = torch.tensor([frame])
    rendering = render_scene(scene, targets.view.camera.select(frames), frames, "reference")
    return FitStep(scene, frames, rendering, targets, torch.Generator().manual_seed(0), "reference")


def _grid(
    columns: int,
    rows: int,
    size: tuple[float, float],
    centre: tuple[float, float],
    depth_m: float,
    scale_m: float,
    generator: torch.Generator,
) -> Gaussians:
    y, x = torch.meshgrid(torch.linspace(-0.5, 0.5, rows), torch.linspace(-0.5, 0.5, columns), indexing="ij")
    means = torch.stack((centre[0] + size[0] * x, centre[1] + size[1] * y, torch.full_like(x, depth_m)), -1).reshape(
        -1, 3
    )
    count = len(means)
    means = means + 0.02 * torch.rand(count, 3, generator=generator)  # no two at the same depth
    upright = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    scales = torch.tensor([scale_m, scale_m, 0.02]).expand(count, 3)
    colours = 0.2 + 0.6 * torch.rand(count, 3, generator=generator)
    made = gaussians_from_points(means, upright, scales, colours, 0.95)
    return replace(made, **{item.name: getattr(made, item.name).double() for item in fields(Gaussians)})
