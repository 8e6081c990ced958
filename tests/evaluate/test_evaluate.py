"""Held-out views: rendered where the documentation says, from nothing but the documented files; and scored."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from pictures import read_picture

from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.dataset.read import open_source, read_colour
from lerobot_msdyn.dataset.rows import read_rows
from lerobot_msdyn.evaluate import __main__ as evaluate
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.nvs import write_nvs_folder

pytestmark = pytest.mark.slow

FAST = ("--fit.steps", "20", "--scene.moving_frames", "6")


def run(*arguments: str) -> int:
    """The exit code of the command."""
    with pytest.raises(SystemExit) as caught:
        run_command(evaluate.run, [*arguments])
    assert isinstance(caught.value.code, int)
    return caught.value.code


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("nvs") / "push"
    write_nvs_folder(make_scene("push", 0, 16, 96, 72), root)
    for path in root.glob("gt/*"):  # nothing else may be read
        if path.name not in ("train.npz", "heldout"):
            path.unlink()
    return root


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with gt/meta.json, which tells what moves, and two held-out cameras."""
    root = tmp_path_factory.mktemp("whole") / "push"
    write_nvs_folder(make_scene("push", 0, 16, 96, 72), root)
    for path in (root / "gt" / "heldout").glob("*.npz"):
        if path.stem not in ("az+05", "el+08"):
            path.unlink()
    return root


def psnr(folder: Path, out: Path, camera: str) -> float:
    """Of the rendered views over pixels that the recorded camera saw at some time."""
    truth = np.load(folder / "gt" / "heldout" / f"{camera}.npz")
    errors = []
    for frame, seen in zip(truth["frame"], np.moveaxis(truth["covis"], -1, 0) > 0, strict=True):
        rendered = read_picture(out / camera / f"rgb_{frame:04d}.png").astype(float)
        true = read_picture(folder / "gt" / "heldout" / camera / f"rgb_{frame:04d}.png").astype(float)
        errors.append(((rendered - true)[seen] ** 2).mean())
    return float(10 * np.log10(255**2 / np.mean(errors)))


def unchanged_psnr(folder: Path, camera: str) -> float:
    """Of the first recorded frame, taken for the view of another camera at that time."""
    source = open_source("local/push", folder / "dataset")
    recorded = read_colour(source, 0, "observation.images.front", read_rows(source, 0))[0].numpy().astype(float)
    true = read_picture(folder / "gt" / "heldout" / camera / "rgb_0000.png")
    return float(10 * np.log10(255**2 / ((recorded - true) ** 2).mean()))


def test_what_moves_is_scored_with_and_without_overlay(whole: Path, tmp_path: Path) -> None:
    for overlay, out in (("true", tmp_path / "with"), ("false", tmp_path / "without")):
        assert run("nvs", "--scene", str(whole), "--out", str(out), "--scene.overlay", overlay, *FAST) == 0
    shown, motion = (json.loads((tmp_path / name / "scores.json").read_text()) for name in ("with", "without"))
    for camera, scores in shown["cameras"].items():
        shares = sum(share for name, share in scores.items() if name.startswith("by_"))
        assert shares == pytest.approx(1, abs=1e-4)
        assert scores["by_overlay"] > 0.3, camera
        alone = motion["cameras"][camera]
        assert alone["by_overlay"] == 0
        # The same scene, once rendered without its overlay, once made without one.
        assert scores["dyn_psnr_without_overlay"] == pytest.approx(alone["dyn_psnr"], abs=0.05)
        assert alone["dyn_psnr_without_overlay"] == alone["dyn_psnr"]
    assert shown["mean"]["dyn_psnr"] > shown["mean"]["dyn_psnr_without_overlay"] + 0.3
    assert shown["what_moves"]["dynamic_db"] > shown["what_moves"]["dynamic_by_motion_db"] + 3
    assert motion["what_moves"]["by_overlay"] == 0


def test_views_are_close_to_the_true_ones(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("nvs", "--scene", str(folder), "--out", str(tmp_path), *FAST) == 0
    printed = capsys.readouterr().out
    assert all(stage in printed for stage in ("read", "priors and initialisation", "fit", "render"))
    cameras = sorted(path.stem for path in (folder / "gt" / "heldout").glob("*.npz"))
    assert {path.name for path in tmp_path.iterdir()} == {*cameras, "scores.json"}
    assert "| mean |" in printed
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert sorted(scores["cameras"]) == cameras
    # Measured at this small size: 20.8, 22.2, 21.6, 22.1 dB.
    for camera in ("az-10", "az+05", "el+08", "tx-05"):
        assert psnr(folder, tmp_path, camera) > max(19.8, unchanged_psnr(folder, camera) + 4), camera
        # The one is of the mean error, the other the mean over the frames.
        assert scores["cameras"][camera]["psnr"] == pytest.approx(psnr(folder, tmp_path, camera), abs=0.3)
        assert "dyn_psnr" not in scores["cameras"][camera]  # gt/meta.json, which tells what moves, is not there


def test_depth_from_a_file(folder: Path, tmp_path: Path) -> None:
    train = np.load(folder / "gt" / "train.npz")
    depth = np.moveaxis(train["depth"], -1, 0).astype(np.float32) * 1e-4
    np.savez(tmp_path / "depth.npz", depth=depth, depth_kind="metric")
    out = tmp_path / "out"
    arguments = ["nvs", "--scene", str(folder), "--out", str(out), "--depth", str(tmp_path / "depth.npz")]
    assert run(*arguments, "--fit.steps", "2", *FAST[2:]) == 0
    assert psnr(folder, out, "az+05") > 18


def test_without_depth_and_without_truth(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blind, out = tmp_path / "blind", tmp_path / "out"
    shutil.copytree(folder, blind, ignore=shutil.ignore_patterns("*.mkv", "az*", "el*", "tx*", "dolly"))
    shutil.copy(folder / "gt" / "heldout" / "az+05.npz", blind / "gt" / "heldout")
    assert run("nvs", "--scene", str(blind), "--out", str(out), "--depth", "none", "--fit.steps", "2") == 0
    assert len(list(out.rglob("*.png"))) > 3
    assert "no scores" in capsys.readouterr().out
    assert json.loads((out / "scores.json").read_text())["cameras"] == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "which evaluation? got 'nothing'"),
        (["video"], "which evaluation? got 'video'"),
        (["nvs", "--out", "x"], "--scene is missing"),
        (["nvs", "--scene", "x"], "--out is missing"),
        (["nvs", "--scene", "absent", "--out", "x"], "train.npz: expected an npz file with K, c2w"),
        (["dycheck", "--out", "x"], "--root is missing"),
        (["dycheck", "--root", "absent", "--out", "x"], "train.json: cannot be read"),
        (["dycheck", "--root", "x", "--out", "x", "--protocol", "nerfies"], "protocol"),
        (["heldout-camera", "--repo", "x", "--train-camera", "a", "--test-camera", "b"], "--calibration is missing"),
    ],
)
def test_bad_input(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*arguments) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
