"""What the joints say of masks and depth: the robot's pixels, what rests, and what it touches."""

import pytest
import torch

from lerobot_msdyn.core.observations import BodyTracks, DepthTraits, RobotSeen
from lerobot_msdyn.priors.registry import Depth
from lerobot_msdyn.priors.robot import with_robot, with_robot_depth

FRAMES, HEIGHT, WIDTH = 3, 60, 80
GREY = torch.full((FRAMES, HEIGHT, WIDTH, 3), 90, dtype=torch.uint8)
ARM, BASE = (slice(5, 40), slice(30, 40)), (slice(40, 55), slice(25, 45))


def robot() -> RobotSeen:
    """An arm 1 m away on a base that rests."""
    depth, moving = torch.zeros(FRAMES, HEIGHT, WIDTH), torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.bool)
    depth[:, *ARM], depth[:, *BASE], moving[:, *ARM] = 1.0, 1.2, True
    nothing = BodyTracks(torch.zeros(0, FRAMES, 3), torch.zeros(0, FRAMES) > 0, torch.zeros(0).long())
    return RobotSeen(depth, moving, nothing, 0.0)


def masks() -> torch.Tensor:
    """The arm, its base and a block that it touches in the last two frames are one instance."""
    found = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    found[:, 5:40, 29:41], found[:, *BASE] = 2, 2
    found[0, 10:20, 60:70] = 1
    found[1:, 10:20, 40:60] = 2
    found[1, 10:20, 58:68] = 1
    return found


def test_the_robot_is_one_instance_without_what_it_touches() -> None:
    found, label = with_robot(masks(), robot(), GREY)
    assert label == 2
    assert bool((found[:, *ARM] == 2).all())
    assert bool((found[:, 5:40, 29] == 2).all())
    assert not bool(found[:, *BASE].any())
    block = found[1:, 10:20, 44:58]
    assert len(block.unique()) == 1
    assert int(block.unique()) not in (0, 2)


def test_what_touches_the_robot_keeps_its_id() -> None:
    seen = masks()
    seen[0, 10:20, 50:60], seen[0, 10:20, 60:70] = 1, 0
    seen[1] = seen[2]
    found, _ = with_robot(seen, robot(), GREY)
    assert set(found[1, 10:20, 46:58].unique().tolist()) == {1}
    assert set(found[2, 10:20, 46:58].unique().tolist()) == {1}


def test_a_robot_that_rests_changes_nothing() -> None:
    still = robot()
    still.moving[:] = False
    found, label = with_robot(masks(), still, GREY)
    assert label == 0
    assert torch.equal(found, masks())


def test_depth_of_the_robot_and_of_what_it_holds() -> None:
    plane = torch.full((FRAMES, HEIGHT, WIDTH), 3.0)
    found, label = with_robot(masks(), robot(), GREY)
    z = with_robot_depth(Depth(plane, DepthTraits()), found, robot(), label).z
    assert bool((z[:, *ARM] == 1).all())
    assert bool((z[:, *BASE] == 1.2).all())
    assert bool((z[:, 10:35, 29] == 1).all())
    torch.testing.assert_close(z[2, 10:20, 46:58], torch.ones(10, 12))
    assert float(z[0, 15, 65]) == 3
    sloped = plane * torch.linspace(1.0, 1.2, WIDTH)
    held = with_robot_depth(Depth(sloped, DepthTraits()), found, robot(), label).z[2, 10:20, 46:58]
    torch.testing.assert_close(held / held[:, :1], sloped[2, 10:20, 46:58] / sloped[2, 10:20, 46:47])
    near = with_robot_depth(Depth(plane / 2.9, DepthTraits()), found, robot(), label).z
    assert bool((near[2, 10:20, 46:58] == plane[0, 0, 0] / 2.9).all())
    measured = Depth(plane, DepthTraits(metric=True, sharp=True))
    assert torch.equal(with_robot_depth(measured, found, robot(), label).z, plane)


def test_what_is_behind_the_robot_and_has_not_moved_is_not_held() -> None:
    plane = torch.full((FRAMES, HEIGHT, WIDTH), 3.0)
    seen = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    seen[:, *ARM], seen[:, 10:20, 40:50] = 2, 1
    arm = robot()
    found, label = with_robot(seen, arm, GREY)
    assert float(with_robot_depth(Depth(plane, DepthTraits()), found, arm, label).z[0, 15, 45]) == 1, (
        "held all the time"
    )
    arm.moving[1, 5:25], seen[1, 5:25, 30:40] = False, 0
    found, label = with_robot(seen, arm, GREY)
    assert float(with_robot_depth(Depth(plane, DepthTraits()), found, arm, label).z[2, 15, 45]) == 1, "for a frame only"
    arm.moving[0, 5:25], seen[0, 5:25, 30:40] = False, 0  # the arm has not come yet
    found, label = with_robot(seen, arm, GREY)
    z = with_robot_depth(Depth(plane, DepthTraits()), found, arm, label).z
    assert bool((z[:, 10:20, 40:50] == 3).all())
    seen[2, 10:20, 40:50], seen[2, 6:16, 40:50] = 0, 1
    found, label = with_robot(seen, arm, GREY)
    z = with_robot_depth(Depth(plane, DepthTraits()), found, arm, label).z
    assert float(z[0, 15, 45]) == 3
    assert float(z[2, 8, 45]) == 1, "lifted"


@pytest.mark.parametrize(("away", "rests"), [(1.12, True), (1.06, False)])
def test_what_rests_little_farther_is_as_far_as_what_touches_it(away: float, rests: bool) -> None:
    plane = torch.full((FRAMES, HEIGHT, WIDTH), away)
    seen = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    seen[:, *ARM], seen[:, 10:20, 40:50] = 2, 1
    arm = robot()
    arm.moving[:2, 5:25], seen[:2, 5:25, 30:40] = False, 0
    found, label = with_robot(seen, arm, GREY)
    z = with_robot_depth(Depth(plane, DepthTraits()), found, arm, label).z
    assert float(z[2, 15, 42]) == pytest.approx(away if rests else 1.0)
