"""Whether a thing lies on the ground or stands on it, told by how it slides, and how thick it is."""

import pytest
import torch
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import project, transform_points
from lerobot_msdyn.core.observations import BodyTracks, DepthTraits, PointTracks, RobotSeen
from lerobot_msdyn.priors.depth.lying import with_lying
from lerobot_msdyn.priors.depth.table_plane import table_plane, with_standing
from lerobot_msdyn.priors.registry import Depth

WIDTH, HEIGHT, FRAMES = 160, 120, 12
K = torch.tensor([[140.0, 0, 80], [0, 140.0, 60], [0, 0, 1]])
CAMERA_M, TILT_DEG = 0.5, 40.0


def filmed(shape: Tensor, turning: float = 0.12, lift: float = 0.0) -> tuple[PointTracks, Tensor]:
    """Tracks and masks of a thing [n,3] (m; x right, y ahead, z up) that turns, slides and is lifted."""
    tilt = torch.deg2rad(torch.tensor(TILT_DEG))
    right, down = torch.tensor([1.0, 0, 0]), torch.stack((torch.tensor(0.0), -tilt.sin(), -tilt.cos()))
    camera_from_world = torch.eye(4)
    camera_from_world[:3, :3] = torch.stack((right, down, torch.linalg.cross(right, down)))
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ torch.tensor([0.0, 0.0, CAMERA_M])
    xy = []
    for frame in range(FRAMES):
        turn = torch.tensor(turning * frame)
        rotation = torch.stack(
            (
                torch.stack((turn.cos(), -turn.sin(), torch.tensor(0.0))),
                torch.stack((turn.sin(), turn.cos(), torch.tensor(0.0))),
                torch.tensor([0.0, 0, 1]),
            )
        )
        place = torch.tensor([0.012 * frame - 0.05, 0.5 + 0.015 * frame, lift * frame])
        xy.append(project(transform_points(camera_from_world, shape @ rotation.T + place), K)[0])
    seen = torch.stack(xy, 1)
    masks = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    for frame, points in enumerate(xy):
        column, row = points.long().unbind(-1)
        masks[frame, row, column] = 1
    visible = torch.ones(seen.shape[:2], dtype=torch.bool)
    return PointTracks(seen, visible, visible.float(), torch.ones(len(seen), dtype=torch.long)), masks


def grid(rows: Tensor, columns: Tensor) -> Tensor:
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"), -1).reshape(-1, 2)


FLAT = torch.cat((grid(torch.linspace(-0.1, 0.1, 18), torch.linspace(-0.05, 0.05, 10)), torch.zeros(180, 1)), 1)


def depths(shape: Tensor, turning: float = 0.12, lift: float = 0.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels of the thing, and depth there: on the ground, standing, and as its motion says."""
    tracks, masks = filmed(shape, turning, lift)
    ground = table_plane(WIDTH, HEIGHT, K, CAMERA_M, TILT_DEG)
    standing = with_standing(ground, masks)
    camera = CameraTrack(K.repeat(FRAMES, 1, 1), torch.eye(4).repeat(FRAMES, 1, 1), WIDTH, HEIGHT)
    found = with_lying(Depth(standing, DepthTraits(), ground), masks, tracks, camera)
    its = masks > 0
    return its, ground.expand_as(standing)[its], standing[its], found.z[its]


def test_what_slides_about_on_its_face_lies_on_the_ground() -> None:
    _, ground, standing, found = depths(FLAT)
    before, after = (float((z / ground - 1).abs().median()) for z in (standing, found))
    assert before > 0.06
    assert after < 0.4 * before


@pytest.mark.parametrize("thick", [0.0, 0.03])
def test_a_robot_that_touches_it_tells_how_thick_it_is(thick: float) -> None:
    tracks, masks = filmed(FLAT + torch.tensor([0.0, 0.0, thick]))
    ground = table_plane(WIDTH, HEIGHT, K, CAMERA_M, TILT_DEG)
    top = table_plane(WIDTH, HEIGHT, K, CAMERA_M - thick, TILT_DEG)
    touching = torch.zeros_like(masks, dtype=torch.bool)
    touching[4:8] = True  # a robot that is seen all around it, as high as its top, for a while
    none = torch.zeros(0, FRAMES)
    bodies = BodyTracks(none[..., None].expand(0, FRAMES, 3), none > 0, none[:, 0].long())
    robot = RobotSeen(torch.where(touching, top, 0.0), touching, bodies, 0.0)
    depth = Depth(with_standing(ground, masks), DepthTraits(), ground)
    camera = CameraTrack(K.repeat(FRAMES, 1, 1), torch.eye(4).repeat(FRAMES, 1, 1), WIDTH, HEIGHT)
    found = with_lying(depth, masks, tracks, camera, robot)
    its = masks > 0
    assert found.lying == {1}
    torch.testing.assert_close(found.z[its], top.expand_as(found.z)[its], rtol=0.005, atol=0)
    unknown = with_lying(depth, masks, tracks, camera)
    torch.testing.assert_close(unknown.z[its], ground.expand_as(found.z)[its], rtol=0.005, atol=0)


def test_what_is_lifted_is_not_laid_down() -> None:
    _, _, standing, found = depths(FLAT, lift=0.02)
    torch.testing.assert_close(found, standing)


def test_what_stands_stays_upright() -> None:
    angle, up = grid(torch.linspace(-1.2, 1.2, 10), torch.linspace(0.0, 0.15, 18)).unbind(-1)
    bottle = torch.stack((0.03 * angle.sin(), -0.03 * angle.cos(), up), -1)
    _, _, standing, found = depths(bottle, turning=0.0)
    torch.testing.assert_close(found, standing)


@pytest.mark.parametrize("lacking", ["ground", "tracks"])
def test_without_a_ground_or_tracks_nothing_is_told(lacking: str) -> None:
    tracks, masks = filmed(torch.randn(40, 3) * 0.02)
    ground = table_plane(WIDTH, HEIGHT, K, CAMERA_M, TILT_DEG)
    z = with_standing(ground, masks)
    camera = CameraTrack(K.repeat(FRAMES, 1, 1), torch.eye(4).repeat(FRAMES, 1, 1), WIDTH, HEIGHT)
    depth = Depth(z, DepthTraits(), None if lacking == "ground" else ground)
    if lacking == "tracks":
        tracks = PointTracks(tracks.xy[:0], tracks.visible[:0], tracks.confidence[:0], tracks.instance[:0])
    assert torch.equal(with_lying(depth, masks, tracks, camera).z, z)
