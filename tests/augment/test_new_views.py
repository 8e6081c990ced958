"""Where new cameras stand, end to end: what the output says of them, and what is refused in one line."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from augment_command import FAST, FRONT, SIDE, run
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.core.geometry import axis_angle_to_matrix, invert_se3, se3
from lerobot_msdyn.dataset.provenance import read_unseen
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.synthetic.scene import SyntheticScene

FRAMES, WIDTH, HEIGHT = 12, 64, 48  # of `desk`


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The true poses of the cameras of `desk`."""
    cameras = {}
    for name, camera in make_scene("push", 0, 1, WIDTH, HEIGHT).cameras.items():
        pose = camera.camera_from_world[0]
        cameras[name] = {"K": camera.intrinsics[0].tolist(), "R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist()}
    path = tmp_path_factory.mktemp("calibration") / "calibration.json"
    path.write_text(json.dumps({"cameras": cameras}))
    return path


def turning_with_the_robot(frames: int) -> SyntheticScene:
    """A scene whose front camera turns back and forth as the state does."""
    scene = make_scene("push", 0, frames, WIDTH, HEIGHT)
    speed = torch.zeros(frames)
    speed[3:9], speed[13:18] = 1.0, -1.0
    path = speed.cumsum(0)
    turn = axis_angle_to_matrix(0.04 * path[:, None] * torch.tensor([0.0, 1.0, 0.0]))
    pose = scene.camera.world_from_camera @ se3(turn, torch.zeros(frames, 3))
    camera = dataclasses.replace(scene.camera, world_from_camera=pose)
    return dataclasses.replace(scene, cameras={"front": camera}, state=path[:, None].repeat(1, 6))


def test_another_cameras_pose_with_masks(
    desk: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new"
    flags = ["--perturbation.type", "other_camera", "--perturbation.camera", "side", "--max_unseen", "1"]
    flags += ["--camera.calibration", str(calibration), "--masks", "true", "--gate.enabled", "false"]
    source = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(out), "--cameras", "[front]"]
    assert run(*source, "--episodes", "[1]", "--variants", "1", *flags, *FAST) == 0
    assert f"shifts are metres ({FRONT})" in capsys.readouterr().out

    recorded, new = pq.read_table(out / "meta" / "msdyn" / "episodes.parquet").to_pylist()
    view = json.loads(new["views"])[FRONT]
    cameras = make_scene("push", 0, 1, WIDTH, HEIGHT).cameras
    for name, known in (("front", json.loads(recorded["views"])[FRONT]), ("side", view)):
        pose = torch.tensor(known["world_from_camera"])
        torch.testing.assert_close(pose, cameras[name].world_from_camera[0], atol=1e-4, rtol=0)
    expected = invert_se3(cameras["side"].world_from_camera[0]) @ cameras["front"].world_from_camera[0]
    torch.testing.assert_close(torch.tensor(view["camera_from_source"]), expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(torch.tensor(view["K"]), cameras["front"].intrinsics[0], atol=1e-3, rtol=0)

    files = sorted(path.name for path in (out / "meta" / "msdyn" / "unseen").iterdir())
    assert files == ["episode_000001.npz"]  # of the new episode; the recorded one has none
    unseen = read_unseen(out / "meta" / "msdyn" / "unseen" / files[0], FRONT)
    assert unseen.shape == (FRAMES, HEIGHT, WIDTH)
    assert 0.02 < unseen.mean() < 0.8

    output = LeRobotDataset("local/desk_msdyn", root=out, video_backend="pyav")
    pictures = [output[FRAMES + i] for i in range(FRAMES)]
    seen = [torch.from_numpy(~mask).expand(3, -1, -1) for mask in unseen]
    to_side = [(item[FRONT] - item[SIDE]).abs()[mask].mean() for item, mask in zip(pictures, seen, strict=True)]
    to_front = [(item[FRONT] - output[i][FRONT]).abs()[seen[i]].mean() for i, item in enumerate(pictures)]
    assert np.mean(to_side) < 0.6 * np.mean(to_front), "it should look like what the side camera recorded"


def test_cameras_that_move_with_the_robot_are_refused(
    image_desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moving = tmp_path / "moving"
    write_dataset([turning_with_the_robot(24)], "local/moving", moving)
    for name, root, camera, reason in (
        ("local/desk", image_desk, "wrist", "wrist moves with the robot, by its name"),
        ("local/moving", moving, "front", "front is refused: its background moves by"),
    ):
        source = ["--repo", name, "--root", str(root), "--new_root", str(tmp_path / "new")]
        assert run(*source, "--cameras", f"[{camera}]") == 2
        (error,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
        assert reason in error
        assert ("--allow_moving" in error) == (camera == "front")
    source = ["--repo", "local/desk", "--root", str(image_desk), "--new_root", str(tmp_path / "new")]
    assert run(*source, "--cameras", "[wrist]", "--allow_moving", "true") == 2
    assert "to which the recorded actions do not belong" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--perturbation.azimuth_deg", "-5"], "perturbation.azimuth_deg is -5.0; expected a value from 0 to 90"),
        (["--fill", "paint"], "fill"),
        (["--max_unseen", "1.5"], "max_unseen is 1.5; expected a value from 0 to 1"),
        (["--perturbation.type", "spin"], "spin"),
        (
            # 30 m ahead of the recorded camera, and turned round
            ["--perturbation.type", "poses", "--perturbation.poses", "[[-1,0,0,0,0,1,0,0,0,0,-1,30]]"],
            "is behind what the recorded camera of episode 0 sees",
        ),
        (
            ["--perturbation.type", "other_camera", "--perturbation.camera", "top"],
            "perturbation.camera is 'top', which the calibration None does not name",
        ),
    ],
    ids=["negative angle", "fill", "share", "kind", "behind the table", "camera"],
)
def test_bad_values_are_one_line(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    source = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(tmp_path / "new")]
    assert run(*source, "--cameras", "[front]", "--episodes", "[0]", "--variants", "1", *FAST, *flags) == 2
    said = capsys.readouterr().err
    (error,) = [line for line in said.splitlines() if line.startswith("error: ")]
    assert message in error
    assert "Traceback" not in said
    assert not (tmp_path / "new").exists()
