"""Forward kinematics against poses that were worked out by hand, and its gradients."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_msdyn.robots import Robot, load_robot
from lerobot_msdyn.robots.kinematics import link_poses

TWO = """<robot name="two">
<link name="base"><visual><geometry><box size="1 1 1"/></geometry></visual></link><link name="arm"/><link name="slide"/>
<link name="copy"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 1"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="out" type="prismatic"><parent link="arm"/><child link="slide"/>
<origin xyz="2 0 0" rpy="0 0 1.5707963267948966"/><axis xyz="1 0 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint>
<joint name="mirror" type="prismatic"><parent link="arm"/><child link="copy"/><axis xyz="1 0 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/><mimic joint="out" multiplier="-2" offset="0.5"/></joint></robot>"""


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    path: Path = tmp_path_factory.mktemp("two") / "two.urdf"
    path.write_text(TWO)
    return load_robot(path)


def test_turning_and_sliding(two: Robot) -> None:
    poses = link_poses(two, torch.tensor([[math.pi / 2, 0.25]], dtype=torch.float64))[0]
    assert two.movable == ("turn", "out")
    assert poses[two.links.index("arm")][:3, 3].tolist() == [0, 0, 1]
    # Turned by 90 degrees, the origin of the slide lies at y = 2, and its x axis points to -x.
    assert poses[two.links.index("slide")][:3, 3].tolist() == pytest.approx([-0.25, 2, 1])
    assert poses[two.links.index("copy")][:3, 3].tolist() == pytest.approx([0, 0.5 - 2 * 0.25, 1])


def test_gradients(arm: Robot) -> None:
    values = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (2, len(arm.movable)))).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: link_poses(arm, v)[..., :3, :], (values,))
