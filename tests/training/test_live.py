"""Frames that are rendered for training are those of the renderer."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.motion.model.bases import MotionLevel, level_from_motions
from lerobot_msdyn.scene import store as saved
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.rendering import render_scene
from lerobot_msdyn.scene.store import SavedScene
from lerobot_msdyn.training.live import LiveScene
from lerobot_msdyn.views.offsets import orbit_offset


@pytest.fixture
def scene(desk_scenes: Path) -> SavedScene:
    return saved.load(saved.list_scenes(desk_scenes)[0]["observation.images.front"])


def turning(scene: DynamicScene, bases: int = 3) -> DynamicScene:
    """The scene with two levels of random motions, in one of which opposite turns cancel out."""
    generator = torch.Generator().manual_seed(0)
    count = len(scene.moving)

    def level(size: float) -> MotionLevel:
        turns = size * torch.randn(bases, scene.frames, 3, generator=generator)
        turns[1:2, 1:] = torch.tensor([0.0, 0.0, torch.pi])
        shifts = 0.1 * torch.randn(bases, scene.frames, 3, generator=generator)
        return level_from_motions(se3(axis_angle_to_matrix(turns), shifts), torch.randn(bases, 3, generator=generator))

    indices = tuple(torch.randint(bases, (count, j), generator=generator) for j in (1, 2))
    logits = tuple(torch.randn(count, j, generator=generator) for j in (1, 2))
    slope = 0.3 * torch.randn(count, 4, 3, generator=generator)
    return replace(
        scene,
        levels=(level(1.0), level(2.0)),
        indices=indices,
        logits=logits,
        moving=replace(scene.moving, sh=slope),
    )


@dataclass(frozen=True)
class Drift:
    """Motion of a kind of its own, without bases."""

    kind: ClassVar[str] = "drift"

    per_frame: torch.Tensor  # m

    def carry(self, positions, orientations, indices, logits, times) -> tuple:
        return self.carry_points(positions, indices, logits, times), orientations

    def carry_points(self, positions, indices, logits, times) -> torch.Tensor:
        return positions + times[:, None, None] * self.per_frame


def drifting(scene: DynamicScene) -> DynamicScene:
    """The scene with a motion that no bases describe."""
    count = len(scene.moving)
    level = Drift(torch.tensor([0.1, 0.0, 0.0]))
    return replace(scene, levels=(level,), indices=(torch.zeros(count, 1).long(),), logits=(torch.zeros(count, 1),))


@pytest.mark.parametrize("change", [lambda scene: scene, turning, drifting], ids=["fitted", "turning", "drifting"])
def test_the_same_picture_as_that_of_the_renderer(
    scene: SavedScene, change: Callable[[DynamicScene], DynamicScene]
) -> None:
    scene = replace(scene, windows=tuple(change(window) for window in scene.windows))
    frames = torch.tensor([2, 8, 9])
    recorded = scene.camera.select(frames)
    offset = orbit_offset(8.0, -4.0, scene.distance)
    camera = replace(recorded, world_from_camera=recorded.world_from_camera @ offset)
    live = LiveScene(scene)
    for _ in range(2):  # buffers are used again
        found = live.render(camera, frames)
    for i, frame in enumerate(frames.tolist()):
        number = int(frame >= 6)
        with torch.no_grad():
            expected = render_scene(
                scene.windows[number], camera.select([i]), torch.tensor([frame - scene.starts[number]])
            )
        known = expected.alpha[0].numpy() >= 0.5
        rgb = 255 * expected.rgb[0].clamp(0, 1).permute(2, 0, 1).numpy()
        assert np.abs(found.rgb[i].astype(float) - rgb)[:, known].max() < 1
        assert np.abs(found.depth[i] - expected.depth[0].numpy())[known].max() < 1e-4
        assert (found.depth[i][~known] == 0).all()
        np.testing.assert_allclose(found.alpha[i], expected.alpha[0].numpy(), atol=1e-4)


def test_depth_without_true_scale_is_unknown(scene: SavedScene) -> None:
    live = LiveScene(replace(scene, metric=False))
    assert (live.render(scene.camera.select([0]), torch.tensor([0])).depth == 0).all()
