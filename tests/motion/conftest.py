"""Hand-built tracks of rigid bodies, and a small scene whose parts are known."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, invert_se3, se3, transform_points
from lerobot_msdyn.motion.to_video.alignment import Sightings, Video, carried_costs, read_video, sight
from lerobot_msdyn.motion.to_video.regroup import Grouping
from lerobot_msdyn.synthetic import SyntheticScene, make_scene

FRAMES = 24
PUSHED_FRAMES = 12


class Body:
    """Points on a rigid body that turns about an axis through its centre while it shifts; at rest before `start`."""

    def __init__(
        self, seed: int, centre: tuple[float, ...], turn: tuple[float, ...], shift: tuple[float, ...], start: int = 0
    ) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.points = torch.tensor(centre) + 0.05 * (torch.rand(60, 3, generator=generator) - 0.5)
        progress = ((torch.arange(FRAMES) - start).clamp(min=0) / (FRAMES - 1 - start))[:, None]
        rotation = axis_angle_to_matrix(progress * torch.tensor(turn))
        pivot = torch.tensor(centre)
        self.motions = se3(rotation, pivot + progress * torch.tensor(shift) - rotation @ pivot)

    @property
    def xyz(self) -> Tensor:
        """Positions [n,t,3]."""
        return transform_points(self.motions, self.points.expand(FRAMES, -1, -1)).transpose(0, 1).contiguous()

    def relative(self, frame: int) -> Tensor:
        """True motions [t,4,4] from a frame to every frame."""
        return self.motions @ torch.linalg.inv(self.motions[frame])


@pytest.fixture
def tumbling() -> Body:
    return Body(0, (0.1, 0.2, 0.8), (0.4, 0.9, -0.5), (0.15, -0.05, 0.1))


@pytest.fixture
def resting() -> Body:
    return Body(1, (-0.1, 0.0, 0.7), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.fixture
def late() -> Body:
    return Body(2, (0.3, 0.1, 0.9), (0.0, 0.6, 0.0), (0.0, 0.2, 0.0), start=12)


@pytest.fixture(scope="session")
def pushed() -> SyntheticScene:
    return make_scene("push", 0, PUSHED_FRAMES, 160, 120)


@pytest.fixture(scope="session")
def video(pushed: SyntheticScene) -> Video:
    view = pushed.render(pushed.camera)
    pixel_m = float(view.depth[view.instances > 0].median() / pushed.camera.intrinsics[0, 0, 0])
    return read_video(view.rgb, view.depth, view.instances, pushed.camera, pixel_m)


@pytest.fixture(scope="session")
def points(video: Video) -> Sightings:
    return sight(video, list(range(0, PUSHED_FRAMES, 2)), 300)


@pytest.fixture(scope="session")
def truth(pushed: SyntheticScene, points: Sightings) -> Grouping:
    """Every body a part, and each point in the part of the nearest tracked point of its instance."""
    tracks = pushed.tracks(1500)
    bodies, part = tracks.body.unique(return_inverse=True)
    own = torch.stack(
        [
            part[
                torch.where(
                    tracks.instance == points.instance[i],
                    (tracks.positions[:, points.frame[i]] - points.xyz[i]).norm(dim=-1),
                    torch.inf,
                ).argmin()
            ]
            for i in range(len(points))
        ]
    )
    instance = torch.zeros(len(bodies), dtype=torch.long)
    instance[part] = tracks.instance
    motions = pushed.world_from_body[bodies].double()
    motions = motions @ invert_se3(motions[:, PUSHED_FRAMES // 2])[:, None]
    return Grouping(own, motions, motions, instance, torch.ones(len(bodies), dtype=torch.bool))


@pytest.fixture(scope="session")
def cost(video: Video, points: Sightings) -> Callable[[Grouping], float]:
    """Mean cost of the points in the parts of a grouping."""

    def of(found: Grouping) -> float:
        costs = carried_costs(video, points, found.motions, torch.arange(PUSHED_FRAMES))
        return float(costs.gather(1, found.part[:, None]).mean())

    return of
