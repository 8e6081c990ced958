"""DyCheck's layout and Shape of Motion's: what is read is what was written, and bad files are named in a line."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.evaluate import __main__ as evaluate
from lerobot_msdyn.evaluate.config import Protocol
from lerobot_msdyn.evaluate.dycheck.iphone import read_sequence
from lerobot_msdyn.evaluate.dycheck.iphone_priors import read_priors
from lerobot_msdyn.synthetic.iphone import write_iphone_folder
from lerobot_msdyn.synthetic.scene import SyntheticScene
from lerobot_msdyn.synthetic.viewpoints import hand_held_camera, heldout_cameras

FRAMES, WIDTH, HEIGHT = 12, 80, 60  # of `sequence`


@pytest.mark.parametrize(("protocol", "factor"), [("som", 1), ("dycheck", 2)])
def test_what_is_read_is_what_was_written(
    sequence: Path, push: SyntheticScene, protocol: Protocol, factor: int
) -> None:
    if protocol == "som":
        pytest.importorskip("pycolmap")
    read = read_sequence(sequence, protocol)
    width, height = WIDTH // factor, HEIGHT // factor
    hand_held = hand_held_camera(FRAMES, WIDTH, HEIGHT).resized(width, height)
    assert read.view.rgb.shape == (FRAMES, height, width, 3)
    torch.testing.assert_close(read.view.camera.intrinsics, hand_held.intrinsics)
    torch.testing.assert_close(read.view.camera.world_from_camera, hand_held.world_from_camera, atol=1e-5, rtol=0)
    truth = heldout_cameras(3, width, height)
    assert read.validation == ("1_00000", "1_00005", "1_00010", "2_00000", "2_00005", "2_00010")
    assert read.frames == (0, 5, 10) * 2
    expected = torch.cat((truth["az+10"].world_from_camera, truth["el+08"].world_from_camera))
    torch.testing.assert_close(read.cameras.world_from_camera, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(read.cameras.intrinsics[:3], truth["az+10"].intrinsics)
    seen = push.render(truth["el+08"], [0, 5, 10])
    assert (read.true_picture("2_00005") == seen.rgb[1].numpy()).all()
    assert 0.6 < read.covisible("2_00005").mean() <= 1
    assert read.view.depth is not None
    torch.testing.assert_close(read.view.depth, push.render(hand_held).depth)


def test_the_camera_sways_as_far_as_is_asked(push: SyntheticScene, tmp_path: Path) -> None:
    write_iphone_folder(push, tmp_path / "seq", sway_deg=20.0)
    poses = read_sequence(tmp_path / "seq", "dycheck").view.camera.world_from_camera
    wanted = hand_held_camera(FRAMES, WIDTH, HEIGHT, 20.0).world_from_camera
    torch.testing.assert_close(poses, wanted, atol=1e-5, rtol=0)


def test_priors_of_the_package(sequence: Path, push: SyntheticScene) -> None:
    pytest.importorskip("pycolmap")
    priors = read_priors(read_sequence(sequence, "som"), WIDTH // 2)
    seen = push.render(hand_held_camera(FRAMES, WIDTH, HEIGHT))
    assert priors.masks is not None
    assert priors.depth is not None
    assert priors.tracks is not None
    assert priors.vis is not None
    assert priors.masks.shape == priors.depth.shape == (FRAMES, HEIGHT // 2, WIDTH // 2)
    # Nearest pixels of the full size: each value is one of the four under a small pixel.
    blocks = seen.depth.numpy().reshape(FRAMES, HEIGHT // 2, 2, WIDTH // 2, 2)
    assert (np.abs(blocks - priors.depth[:, :, None, :, None]).min((2, 4)) < 1e-4).all()
    assert abs(priors.masks.mean() - (seen.instances.numpy() > 0).mean()) < 0.02
    on_mask = []
    for frame in range(FRAMES):
        x, y = priors.tracks[priors.vis[:, frame], frame].astype(int).T
        on_mask.append(priors.masks[frame, y, x].mean())
    assert np.mean(on_mask) > 0.8  # at half the size points near an outline are beside it
    assert len(priors.tracks) > 50


def test_without_the_package_only_the_cameras_are_demanded(sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    root = tmp_path / "raw"
    shutil.copytree(sequence, root)
    package = root / "flow3d_preprocessed"
    for name in ("track_anything", "aligned_depth_anything_colmap", "2d_tracks"):
        shutil.rmtree(package / name)
    (package / "colmap" / "sparse" / "points3D.bin").unlink()
    priors = read_priors(read_sequence(root, "som"), WIDTH)
    assert (priors.masks, priors.depth, priors.tracks) == (None, None, None)
    shutil.rmtree(package)
    assert len(read_sequence(root, "dycheck").view.rgb) == FRAMES
    with pytest.raises(DatasetError, match="--protocol som needs Shape of Motion's package"):
        read_sequence(root, "som")


def test_a_mask_of_another_size_is_named(sequence: Path, tmp_path: Path) -> None:
    root = tmp_path / "small"
    shutil.copytree(sequence, root, ignore=shutil.ignore_patterns("flow3d_preprocessed"))
    cv2.imwrite(str(root / "covisible" / "2x" / "val" / "1_00005.png"), np.zeros((8, 9), np.uint8))
    with pytest.raises(DatasetError, match=r"1_00005.png: is \(8, 9\) \(height, width\), the fitted"):
        read_sequence(root, "dycheck").covisible("1_00005")


def _no_validation(root: Path) -> None:
    (root / "splits" / "val.json").write_text(json.dumps({"frame_names": [], "time_ids": []}))


def _millimetres(root: Path) -> None:
    for path in (root / "depth" / "2x").iterdir():
        np.save(path, 1000 * np.load(path))


def _other_camera(root: Path) -> None:
    (root / "camera" / "0_00003.json").write_text('{"focal_length": 100}')


def _no_picture(root: Path) -> None:
    (root / "rgb" / "2x" / "0_00002.png").unlink()


def _deep_picture(root: Path) -> None:
    cv2.imwrite(str(root / "rgb" / "2x" / "0_00002.png"), np.zeros((30, 40), np.uint16))


def _no_split(root: Path) -> None:
    (root / "splits" / "train.json").unlink()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_no_validation, "splits/val.json names no picture"),
        (_millimetres, "expected metres"),
        (_other_camera, "0_00003.json: no camera of the kind that DyCheck uses"),
        (_no_picture, "0_00002.png: absent or no picture"),
        (_deep_picture, "0_00002.png: is uint16"),
        (_no_split, "train.json: cannot be read"),
    ],
)
def test_bad_files_are_named(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: object, message: str
) -> None:
    root = tmp_path / "bad"
    shutil.copytree(sequence, root, ignore=shutil.ignore_patterns("flow3d_preprocessed"))
    assert callable(spoil)
    spoil(root)
    with pytest.raises(SystemExit) as caught:
        run_command(
            evaluate.run, ["dycheck", "--root", str(root), "--out", str(tmp_path / "out"), "--protocol", "dycheck"]
        )
    assert caught.value.code == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
