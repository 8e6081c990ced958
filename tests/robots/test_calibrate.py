"""The command: from a dataset and a description to a calibration file that the other commands read."""

import json
from pathlib import Path
from typing import Any

import augment_command as augment
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from filmed_arm import FRONT, HEIGHT, NAMES, WIDTH, camera, write_filmed
from made_up_arms import swing

from lerobot_msdyn import calibrate
from lerobot_msdyn.augment import robot_cameras
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.robot_cameras import NAME, Place, RobotCameras, calibrated, places_of
from lerobot_msdyn.core.config import CameraConfig, PriorsConfig, RobotConfig
from lerobot_msdyn.core.errors import ConfigError, DatasetError, EpisodeError, PriorError
from lerobot_msdyn.dataset.calibration import read_calibration
from lerobot_msdyn.dataset.provenance import CALIBRATION, FOLDER, TABLE
from lerobot_msdyn.dataset.read import open_source, read_episode
from lerobot_msdyn.evaluate import nvs
from lerobot_msdyn.evaluate.config import EvaluateConfig
from lerobot_msdyn.priors import estimate_priors
from lerobot_msdyn.robots import Robot, map_joints
from lerobot_msdyn.robots.calibration.refine import Solution
from lerobot_msdyn.robots.calibration.solve import Verdict

JOINTS = (np.zeros(6), np.ones(6))
POSE = camera(-50, 25, 0.9, 50)


@pytest.fixture(scope="module")
def recorded(arm: Robot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_filmed(tmp_path_factory.mktemp("filmed") / "arm", arm, POSE)


def command(root: Path, urdf: Path, out: Path, *more: str) -> int:
    flags = ("--repo=local/arm", f"--root={root}", f"--robot.urdf={urdf}", f"--out={out}")
    return calibrate.run([*flags, *more])


def record(urdf: Path, out: Path, **changes: object) -> Path:
    """The calibration file that is right."""
    joints = {name: {"column": k, "scale": float(np.pi / 180), "offset": 0.0} for k, name in enumerate(NAMES[:5])} | {
        "gripper": {"column": 5, "scale": 0.016, "offset": -0.2}
    }
    focal = POSE.focal * WIDTH
    content = {
        "cameras": {
            "front": {
                "K": [[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]],
                "R": POSE.rotation.tolist(),
                "t": POSE.translation.tolist(),
            }
        },
        "robot": {"urdf": str(urdf), "licence": "as its author gives it", "joints": joints, "lag_s": 0.0} | changes,
    }
    out.write_text(json.dumps(content))
    return out


@pytest.mark.slow
def test_from_dataset_to_calibration(
    recorded: Path, urdf: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "arm.json"
    assert command(recorded, urdf, out) == 0
    content = json.loads(out.read_text())
    entry = content["cameras"][FRONT]
    assert np.array(entry["R"]) == pytest.approx(POSE.rotation, abs=0.02)
    assert np.array(entry["t"]) == pytest.approx(POSE.translation, abs=0.03)
    assert entry["K"][0][0] == pytest.approx(POSE.focal * WIDTH, rel=0.03)
    assert np.array(entry["covariance"]).shape == (7, 7)
    assert (out.parent / "arm_links_front.png").exists()
    assert "of the outlines on edges" in capsys.readouterr().out
    episode = read_episode(open_source("local/arm", recorded), 0, [FRONT], CameraConfig(calibration=out))
    assert episode.views[FRONT].camera.origin == "calibration"
    assert episode.views[FRONT].robot is not None


@pytest.mark.parametrize(
    ("flags", "error", "expected"),
    [
        (["--robot.urdf=/absent/arm.urdf"], ConfigError, "/absent/arm.urdf: the robot's description cannot be read"),
        (["--robot.joints={a: shoulder}"], ConfigError, "expected joints of arm"),
        (["--robot.units=gradians"], ConfigError, "robot.units is 'gradians'"),
        (["--frames=3"], ConfigError, "frames is 3"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(
    recorded: Path, urdf: Path, tmp_path: Path, flags: list[str], error: type[Exception], expected: str
) -> None:
    with pytest.raises(error, match=expected):
        command(recorded, urdf, tmp_path / "c.json", *flags)
    assert list(tmp_path.iterdir()) == []


def test_poses_of_the_hand_are_refused(arm: Robot, urdf: Path, tmp_path: Path) -> None:
    names = ("x", "y", "z", "rx", "ry", "rz")
    root = write_filmed(tmp_path / "hand", arm, POSE, 1, 12, names)
    with pytest.raises(ConfigError, match="inverse kinematics is not done"):
        command(root, urdf, tmp_path / "c.json")


def test_two_cameras_of_one_arm_share_its_world(arm: Robot, urdf: Path, tmp_path: Path) -> None:
    side, key = camera(35, 40, 1.0, 60), "observation.images.side"
    root = write_filmed(tmp_path / "arm", arm, POSE, 2, 30, others={key: side})
    out = tmp_path / "both.json"
    assert command(root, urdf, out) == 0
    true = {FRONT: POSE, key: side}
    found = {name: read_calibration(out, name, 0, 1, WIDTH, HEIGHT) for name in true}
    apart = {}
    for name, pose in true.items():
        view = found[name]
        assert view is not None
        matrix = view.world_from_camera[0].numpy()
        assert np.linalg.norm(matrix[:3, 3] - pose.centre) < 0.02 * pose.distance
        apart[name] = matrix
    relative = np.linalg.inv(apart[FRONT]) @ apart[key]
    wanted = POSE.rotation @ side.rotation.T
    assert np.degrees(np.arccos((np.trace(relative[:3, :3] @ wanted.T) - 1) / 2)) < 1.0
    assert {path.name for path in tmp_path.glob("*.png")} == {"both_links_front.png", "both_links_side.png"}


@pytest.mark.parametrize("wrap", [lambda names: [names], lambda names: {"motors": names}, lambda names: names])
def test_names_may_be_wrapped(recorded: Path, wrap: Any) -> None:
    source = open_source("local/arm", recorded)
    source.features["observation.state"]["names"] = wrap(list(NAMES))
    assert robot_cameras.names_of_state(source) == list(NAMES)


def test_too_few_frames_are_refused(arm: Robot, urdf: Path, tmp_path: Path) -> None:
    root = write_filmed(tmp_path / "short", arm, POSE, 1, 5)
    with pytest.raises(DatasetError, match="5 frames; expected at least 12"):
        command(root, urdf, tmp_path / "c.json")


def test_the_arm_and_its_table_are_priors(recorded: Path, urdf: Path, tmp_path: Path) -> None:
    config = CameraConfig(calibration=record(urdf, tmp_path / "c.json"))
    view = read_episode(open_source("local/arm", recorded), 0, [FRONT], config).views[FRONT].select(slice(0, 8))
    assert view.robot is not None
    assert view.robot.ground_m == pytest.approx(0, abs=1e-3)
    priors = estimate_priors(view, PriorsConfig(depth="plane", cache="off"), config)
    arm = view.robot.depth > 0
    assert torch.equal(priors.depth[arm], view.robot.depth[arm])
    assert priors.metric
    assert priors.provenance["robot"]["model"] == "arm"
    assert priors.provenance["robot"]["licence"] == "as its author gives it"
    moving = view.robot.moving
    assert priors.instances[moving].unique().numel() == 1
    assert int(priors.instances[moving].unique()) > 0
    # Where the table is seen, its points lie at the height of the base.
    row, column = HEIGHT - 2, 3
    ray = torch.tensor([(column + 0.5 - WIDTH / 2), (row + 0.5 - HEIGHT / 2), POSE.focal * WIDTH]).double()
    point = ray / ray[2] * float(priors.depth[0, row, column])
    height = (torch.from_numpy(POSE.rotation.T) @ (point - torch.from_numpy(POSE.translation)))[2]
    assert float(height) == pytest.approx(0, abs=2e-3)


def test_a_smaller_picture_shows_the_same_arm(recorded: Path, urdf: Path, tmp_path: Path) -> None:
    config = CameraConfig(calibration=record(urdf, tmp_path / "c.json"))
    view = read_episode(open_source("local/arm", recorded), 0, [FRONT], config).views[FRONT]
    small = view.shrunk(80)
    assert view.robot is not None
    assert small.robot is not None
    assert small.robot.depth.shape == (len(view), 60, 80)
    share = float((small.robot.depth > 0).float().mean() / (view.robot.depth > 0).float().mean())
    assert share == pytest.approx(1, abs=0.05)


@pytest.mark.slow
def test_new_views_by_the_arm(recorded: Path, urdf: Path, tmp_path: Path) -> None:
    out = tmp_path / "new"
    arguments = ("--repo=local/arm", f"--root={recorded}", f"--new_root={out}", "--episodes=[0]", "--variants=1")
    more = ("--priors.masks=change", "--priors.depth=plane", "--gate.enabled=false", "--workers=1")
    assert augment.run(*arguments, *more, f"--robot.urdf={urdf}", *augment.FAST) == 0
    recorded_row, row = pq.read_table(out / TABLE).to_pylist()
    pose = np.array(json.loads(recorded_row["views"])[FRONT]["world_from_camera"])
    np.testing.assert_allclose(pose[:3, :3].T, POSE.rotation, atol=0.02)
    new_pose = np.array(json.loads(row["views"])[FRONT]["world_from_camera"])
    assert 0.001 < np.linalg.norm(new_pose[:3, 3] - pose[:3, 3]) < 0.5
    assert "the table that the robot stands on" in row["priors"]
    assert "as its author gives it" in row["priors"]
    content = json.loads((out / FOLDER / CALIBRATION / NAME).read_text())
    assert content["robot"]["urdf"] == urdf.name
    assert np.array(content["cameras"][FRONT]["R"]) == pytest.approx(POSE.rotation, abs=0.02)
    assert "links_front" in (out / "report.html").read_text()


def test_a_robot_that_is_not_known_is_no_obstacle(recorded: Path, tmp_path: Path) -> None:
    config, source = AugmentConfig(), open_source("local/arm", recorded)
    source.info.robot_type = "unheard of"
    assert calibrated(source, [0], [FRONT], config, tmp_path) is config
    config.robot.name = "unheard of"
    with pytest.raises(ConfigError, match="unheard of"):
        calibrated(source, [0], [FRONT], config, tmp_path)
    config.camera.by_robot = False
    assert calibrated(source, [0], [FRONT], config, tmp_path) is config
    assert list(tmp_path.iterdir()) == []


def test_an_episode_whose_pictures_are_broken_is_left_out(
    recorded: Path, urdf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = robot_cameras.read_colour

    def broken(source: Any, index: int, key: str, rows: Any, frames: Any) -> Any:
        if index == 1 and len(frames) > 2:
            raise EpisodeError("episode 1: broken in the middle")
        return whole(source, index, key, rows, frames)

    monkeypatch.setattr(robot_cameras, "read_colour", broken)
    monkeypatch.setattr(
        robot_cameras, "solve", lambda robot, values, *_: Verdict(Solution(POSE, *JOINTS), 1.0, 1.0, "", 0.0)
    )
    found = robot_cameras.robot_cameras(
        open_source("local/arm", recorded), [FRONT], [0, 1], RobotConfig(urdf=urdf), frames=40
    )
    (place,) = found.places[FRONT]
    assert list(place.frames) == [0]
    assert len(place.pictures) == len(place.frames[0])


def test_each_place_of_a_camera_has_an_entry_or_none(arm: Robot, urdf: Path, tmp_path: Path) -> None:
    moved = ((0, 0), (12, 12), (0, 0), (0, 12))
    source = open_source("local/arm", write_filmed(tmp_path / "arm", arm, POSE, 4, 8, moved_px=moved))
    assert places_of(source, FRONT, range(4)) == [[0, 2], [1]]
    solution = Solution(POSE, *JOINTS)
    sure, unsure = (Verdict(solution, 0.9, 0.2, doubt, 1.0) for doubt in ("", "another camera fits as well"))
    nothing = np.zeros((0, 1, 1, 3), np.uint8)
    mapping = map_joints(arm, NAMES, swing(24, 0))
    places = [Place([0, 2], {}, nothing, sure), Place([1], {}, nothing, unsure)]
    path = tmp_path / "c.json"
    path.write_text(json.dumps(RobotCameras(arm, mapping, [0, 1, 2, 3], {FRONT: places}).content(source)))
    found = [read_calibration(path, FRONT, episode, 1, WIDTH, HEIGHT) for episode in range(4)]
    assert [camera is not None for camera in found] == [True, False, True, False]
    whole = RobotCameras(arm, mapping, [0, 2], {FRONT: places[:1]}).content(source)
    assert list(whole["cameras"]) == [FRONT]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"joints": {"pan": {"column": 0, "scale": 1.0, "offset": 0.0}}}, "calibrate again"),
        ({"joints": {"pan": {}}}, "its entry `robot` cannot be used"),
    ],
)
def test_a_calibration_of_another_robot_is_named(
    recorded: Path, urdf: Path, tmp_path: Path, changes: dict[str, object], expected: str
) -> None:
    config = CameraConfig(calibration=record(urdf, tmp_path / "c.json", **changes))
    with pytest.raises(PriorError, match=expected):
        read_episode(open_source("local/arm", recorded), 0, [FRONT], config)


def test_held_out_views_are_drawn_with_what_the_joints_tell(
    arm: Robot, recorded: Path, urdf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`evaluate nvs` looks for the robot, and puts its links before the true camera, at the same pixels."""
    folder, out = tmp_path / "scene", tmp_path / "out"
    (folder / "gt").mkdir(parents=True)
    (folder / "dataset").symlink_to(recorded)
    focal = 1.1 * POSE.focal * WIDTH
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    frames = 24
    np.savez(folder / "gt" / "train.npz", K=K, c2w=np.eye(4)[None].repeat(frames, 0))
    stale = out / nvs.ROBOT / NAME
    stale.parent.mkdir(parents=True)
    stale.write_text("of another scene")

    def found(source: Any, episodes: Any, cameras: Any, config: EvaluateConfig, place: Path) -> EvaluateConfig:
        assert (episodes, cameras, place, stale.exists()) == ([0], [FRONT], stale.parent, False)
        config.camera.calibration = record(urdf, tmp_path / "c.json")
        return config

    monkeypatch.setattr(nvs, "calibrated", found)
    view = nvs.read_view(EvaluateConfig(scene_folder=folder, out=out, depth="none"))
    config = CameraConfig(calibration=tmp_path / "c.json")
    told = read_episode(open_source("local/arm", recorded), 0, [FRONT], config).views[FRONT].robot
    assert view.robot is not None
    assert told is not None
    torch.testing.assert_close(view.robot.depth, 1.1 * told.depth)
    seen = view.robot.bodies.xyz[view.robot.bodies.visible]
    column, row = (seen[:, axis] / seen[:, 2] * focal + size / 2 for axis, size in ((0, WIDTH), (1, HEIGHT)))
    assert bool(((column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)).all())
    assert torch.equal(view.robot.moving, told.moving)
