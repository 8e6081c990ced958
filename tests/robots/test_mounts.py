"""Cameras that a robot's description names."""

from pathlib import Path

import numpy as np
import pytest
from filmed_arm import HEIGHT, NAMES, WIDTH, camera
from made_up_arms import swing, write_arm
from scipy.spatial.transform import Rotation

from lerobot_msdyn.robots import load_robot, map_joints
from lerobot_msdyn.robots.calibration import search
from lerobot_msdyn.robots.calibration.contours import Posed
from lerobot_msdyn.robots.calibration.frames import surface
from lerobot_msdyn.robots.calibration.mounts import AXES_FROM_OPTICAL, FOVS_DEG, mounted_cameras

TRUE = camera(-40, 30, 0.8, 56)


def with_cameras(folder: Path) -> Path:
    """An arm with a camera that stands still, named twice, and one that rides on the wrist."""
    path = write_arm(folder)
    place = " ".join(map(str, TRUE.centre))
    links, joints = "", ""
    for name, parent, xyz, rotation in (
        ("head_cam", "base", place, TRUE.rotation.T @ AXES_FROM_OPTICAL.T),
        ("front_optical_frame", "base", place, TRUE.rotation.T),
        ("wrist_camera", "wrist_link", "0 0 0", np.eye(3)),
    ):
        rpy = " ".join(map(str, Rotation.from_matrix(rotation).as_euler("xyz")))
        links += f'<link name="{name}"/>'
        joints += (
            f'<joint name="{name}_joint" type="fixed"><parent link="{parent}"/><child link="{name}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/></joint>'
        )
    path.write_text(path.read_text().replace("</robot>", f"{links}{joints}</robot>"))
    return path


def test_cameras_of_the_description_are_looked_through_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot(with_cameras(tmp_path / "arm"))
    state = swing(24)
    values = map_joints(robot, NAMES, state).values(state)
    found = mounted_cameras(robot, values)
    assert len(found) == 2 * len(FOVS_DEG)
    for pose in found:
        assert search.angle_between(pose.rotation, TRUE.rotation) < 1e-6
        np.testing.assert_allclose(pose.centre, TRUE.centre, atol=1e-9)
    posed = Posed(robot, values)
    masks = np.stack([posed.drawn(frame, TRUE, WIDTH, HEIGHT)[1] >= 0 for frame in range(len(state))])
    monkeypatch.setattr(search, "_everywhere", lambda _: [])
    best = search.search(masks, surface(robot, values), found)[0]
    assert search.angle_between(best.pose.rotation, TRUE.rotation) < np.radians(3)
    assert best.score > 0.85


def test_a_description_without_cameras_names_none(tmp_path: Path) -> None:
    robot = load_robot(write_arm(tmp_path / "arm"))
    state = swing(4)
    assert mounted_cameras(robot, map_joints(robot, NAMES, state).values(state)) == []
