"""One camera of a rig fitted, another compared with: what takes part in what."""

import json
from pathlib import Path

import numpy as np
import pytest

from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.evaluate import __main__ as evaluate
from lerobot_msdyn.evaluate.heldout import score_half, shows_something
from lerobot_msdyn.evaluate.scores import TrueViews
from lerobot_msdyn.synthetic import make_scene


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the cameras of `desk`."""
    scene = make_scene("push", 0, 2, 64, 48)
    cameras = {}
    for name in ("front", "side"):
        pose = scene.cameras[name].camera_from_world[0]
        cameras[name] = {
            "K": scene.cameras[name].intrinsics[0].tolist(),
            "R": pose[:3, :3].tolist(),
            "t": pose[:3, 3].tolist(),
        }
    path = tmp_path_factory.mktemp("rig") / "calibration.json"
    path.write_text(json.dumps({"cameras": cameras}))
    return path


def arguments(desk: Path, calibration: Path, out: Path, train: str = "front", test: str = "side") -> list[str]:
    flags = {
        "repo": "local/desk",
        "root": desk,
        "train-camera": train,
        "test-camera": test,
        "calibration": calibration,
        "out": out,
        "episode": 1,
        "fit.steps": 20,
        "scene.moving_frames": 4,
    }
    return ["heldout-camera", *(f"--{name}={value}" for name, value in flags.items())]


@pytest.mark.slow
def test_the_fit_beats_the_recorded_picture(
    desk: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate.run(arguments(desk, calibration, tmp_path)) == 0
    printed = capsys.readouterr().out
    written = json.loads((tmp_path / "scores.json").read_text())
    assert len(list(tmp_path.glob("rgb_*.png"))) == 12
    assert written["train_camera"] == "observation.images.front"
    assert written["depth_from"] == []
    assert 0.3 < written["covered"] < 1
    rows = written["rows"]
    assert rows["this fit"]["psnr"] > rows["recorded picture"]["psnr"] + 2
    assert rows["depth warp"]["psnr"] > rows["recorded picture"]["psnr"]
    for name in rows:
        assert f"| {name} |" in printed


def test_colours_are_fitted_to_the_other_half_of_the_frames() -> None:
    rendered = np.random.default_rng(0).integers(0, 100, (4, 30, 40, 3)).astype(np.uint8)
    true = rendered + np.uint8(50)
    seen = np.full(rendered.shape[:3], 2, np.uint8)
    assert score_half(rendered, TrueViews(true, seen))["psnr"] > 50
    true[1::2] += 20  # of the half that is scored: not made up for
    assert score_half(rendered, TrueViews(true, seen))["psnr"] == pytest.approx(20 * np.log10(255 / 20), abs=0.2)


def test_the_black_border_of_undistorted_pictures_is_left_out() -> None:
    pictures = np.random.default_rng(0).integers(0, 200, (5, 20, 30, 3)).astype(np.uint8)
    pictures[:, :, :6] = 3
    expected = np.ones((20, 30), bool)
    expected[:, :8] = False
    assert (shows_something(pictures) == expected).all()


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        ("front", "front", "are both observation.images.front"),
        ("front", "left", "no colour camera 'left'"),
        ("front", "side", "does not name observation.images.side for episode 1"),
    ],
)
def test_bad_input(
    desk: Path,
    calibration: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    train: str,
    test: str,
    message: str,
) -> None:
    content = json.loads(calibration.read_text())
    del content["cameras"]["side"]
    path = tmp_path / "one.json"
    path.write_text(json.dumps(content))
    with pytest.raises(SystemExit) as caught:
        run_command(evaluate.run, arguments(desk, path, tmp_path / "out", train, test))
    assert caught.value.code == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
