"""What a robot's joints say of a video, taken over to a camera that is known better."""

import torch

from lerobot_msdyn.core.cameras import CameraTrack, static_camera
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, project, se3, transform_points
from lerobot_msdyn.core.observations import BodyTracks, RobotSeen, View
from lerobot_msdyn.robots.seen import through


def fixed(focal: float, turn: tuple[float, float, float], place: tuple[float, float, float]) -> CameraTrack:
    K = torch.tensor([[[focal, 0, 32.0], [0, focal, 24.0], [0, 0, 1]]])
    pose = se3(axis_angle_to_matrix(torch.tensor(turn)), torch.tensor(place))
    return CameraTrack(K, pose[None], 64, 48)


def pixels(camera: CameraTrack, points: torch.Tensor) -> torch.Tensor:
    return project(transform_points(camera.camera_from_world[0], points), camera.intrinsics[0])[0]


def test_every_point_stays_at_its_pixel_and_the_ground_below_it() -> None:
    down = 2.2  # rad about x: from z up to looking ahead and down
    told, known = fixed(60.0, (-down, 0.02, 0.0), (0, -0.5, 0.5)), fixed(66.0, (-down, 0.0, 0.01), (0.3, -0.55, 0.7))
    xyz = torch.randn(7, 3, 3, generator=torch.Generator().manual_seed(0)) * 0.05
    bodies = BodyTracks(xyz, torch.ones(7, 3) > 0, torch.zeros(7).long())
    depth = torch.full((3, 48, 64), 0.5)
    moved = through(RobotSeen(depth, depth > 0, bodies, -0.02), told, known)
    before, after = pixels(told, xyz.flatten(0, 1)), pixels(known, moved.bodies.xyz.flatten(0, 1))
    torch.testing.assert_close(after, before, atol=1e-3, rtol=0)
    torch.testing.assert_close(moved.depth, 1.1 * depth)
    in_told, in_known = (
        transform_points(camera.camera_from_world[0], points.flatten(0, 1))[:, 2]
        for camera, points in ((told, xyz), (known, moved.bodies.xyz))
    )
    torch.testing.assert_close(in_known, 1.1 * in_told)
    same = through(RobotSeen(depth, depth > 0, bodies, -0.02), told, told)
    torch.testing.assert_close(same.bodies.xyz, xyz, atol=1e-5, rtol=0)
    assert abs(same.ground_m + 0.02) < 1e-5
    higher = fixed(60.0, (-down, 0.02, 0.0), (0, -0.5, 0.8))
    assert abs(through(RobotSeen(depth, depth > 0, bodies, -0.02), told, higher).ground_m - 0.28) < 1e-5


def test_a_cropped_video_has_depth_and_robot_of_the_same_pixels() -> None:
    depth = torch.arange(2 * 48 * 64.0).reshape(2, 48, 64)
    bodies = BodyTracks(torch.zeros(0, 2, 3), torch.zeros(0, 2) > 0, torch.zeros(0).long())
    rgb = (depth[..., None].expand(-1, -1, -1, 3) % 256).to(torch.uint8)
    camera = static_camera(torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), 2, 64, 48)
    view = View(rgb, camera, depth, robot=RobotSeen(2 * depth, depth % 2 > 0, bodies, 0.0))
    part = view.cropped(slice(3, 13), slice(8, 24))
    assert part.depth is not None
    assert part.robot is not None
    assert part.rgb.shape == (2, part.camera.height, part.camera.width, 3) == (2, 10, 16, 3)
    assert torch.equal(part.robot.depth, 2 * part.depth)
    assert torch.equal(part.robot.moving, part.depth % 2 > 0)
    assert part.depth[1, 0, 0] == depth[1, 3, 8]
