"""Each file of DyCheck's layout and of Shape of Motion's, written by hand, means what published loaders take it for.

Those are `dycheck/datasets/{iphone,nerfies}.py` with `dycheck/geometry/camera.py`, and `flow3d/data/iphone_dataset.py`.
"""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, project, transform_points
from lerobot_msdyn.evaluate.config import Protocol
from lerobot_msdyn.evaluate.dycheck.iphone import IphoneSequence, read_sequence
from lerobot_msdyn.evaluate.dycheck.iphone_priors import read_priors

FRAMES, WIDTH, HEIGHT = 12, 80, 60  # of `sequence`
VAL = ("1_00000", "1_00005", "1_00010", "2_00000", "2_00005", "2_00010")
PACKAGE = "flow3d_preprocessed"


@pytest.fixture
def raw(sequence: Path, tmp_path: Path) -> Path:
    """The sequence without the package, to be changed."""
    return shutil.copytree(sequence, tmp_path / "raw", ignore=shutil.ignore_patterns(PACKAGE))


@pytest.fixture
def packaged(sequence: Path, tmp_path: Path) -> Path:
    """The sequence with the package, to be changed."""
    pytest.importorskip("pycolmap")
    return shutil.copytree(sequence, tmp_path / "packaged")


def change(path: Path, **values: Any) -> dict[str, Any]:
    """A JSON file with some of its values replaced."""
    content = json.loads(path.read_text()) | values
    path.write_text(json.dumps(content))
    return content


def bgra(path: Path) -> np.ndarray:
    """A picture as OpenCV reads and writes it."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def pixels(read: IphoneSequence, points: torch.Tensor) -> torch.Tensor:
    """Where the first validation camera sees points [n, 3] of the world, px [n, 2]."""
    return project(transform_points(read.cameras.camera_from_world[0], points), read.cameras.intrinsics[0])[0]


def test_a_camera_file_is_one_of_nerfies(raw: Path) -> None:
    """Rows of `orientation` are the camera's axes in the world; intrinsics are at 1x, and half of that at 2x."""
    turn = axis_angle_to_matrix(torch.tensor([0.3, -0.5, 0.2])).double()
    position = torch.tensor([0.4, -0.2, 0.1], dtype=torch.float64)
    change(
        raw / "camera" / "1_00000.json",
        orientation=turn.tolist(),
        position=position.tolist(),
        focal_length=100.0,
        principal_point=[37.0, 33.5],
        skew=2.0,
        pixel_aspect_ratio=1.1,
    )
    points = torch.tensor([[0.1, 0.2, 2.0], [-0.3, 0.1, 3.0]]).double() @ turn + position
    x, y = torch.tensor([[0.05, 0.1], [-0.1, 1 / 30]]).T
    expected = torch.stack((100 * x + 2 * y + 37.0, 110 * y + 33.5), dim=-1) / 2
    torch.testing.assert_close(pixels(read_sequence(raw, "dycheck"), points.float()), expected, atol=1e-4, rtol=0)


def test_a_refined_camera_is_one_of_colmap(packaged: Path) -> None:
    """World to camera by a quaternion w x y z; in a unit of which scale.npy tells the metres."""
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # by 90 degrees about z
    quaternion, shift = (0.5**0.5, 0.0, 0.0, 0.5**0.5), (0.2, -0.1, 0.4)
    names = [f"0_{i:05d}" for i in range(FRAMES)] + list(VAL)
    cameras = struct.pack("<QiiQQ4d", 1, 7, 1, WIDTH, HEIGHT, 90.0, 95.0, 41.0, 29.0)
    images = [struct.pack("<Q", len(names))]
    for i, name in enumerate(names):
        images.append(struct.pack("<i7di", 100 + i, *quaternion, *shift, 7) + name.encode() + b".png\0" + bytes(8))
    sparse = packaged / PACKAGE / "colmap" / "sparse"
    (sparse / "cameras.bin").write_bytes(cameras)
    (sparse / "images.bin").write_bytes(b"".join(images))
    np.save(sparse.parent / "scale.npy", np.array(2.5))
    seen = torch.tensor([[0.1, -0.2, 2.0]])  # m, by the camera
    points = (seen - 2.5 * torch.tensor(shift)) @ turn
    read = read_sequence(packaged, "som")
    assert read.metres == 2.5
    torch.testing.assert_close(pixels(read, points), torch.tensor([[45.5, 19.5]]), atol=1e-3, rtol=0)


def test_cameras_of_pictures_of_another_size_are_refused(raw: Path) -> None:
    change(raw / "camera" / "1_00005.json", image_size=[WIDTH // 2, HEIGHT // 2])
    with pytest.raises(
        DatasetError, match=r"camera of 1_00005 is one of 40x30 px, pictures in rgb/2x are 40x30; expec"
    ):
        read_sequence(raw, "dycheck")


def test_without_splits_camera_0_is_fitted(raw: Path) -> None:
    """As DyCheck's loader splits: by camera_id, with warp_id as time; ids and times are from 0."""
    before = read_sequence(raw, "dycheck")
    shutil.rmtree(raw / "splits")
    read = read_sequence(raw, "dycheck")
    assert (read.names, read.validation, read.frames) == (before.names, before.validation, before.frames)
    assert read.names[0] == "0_00000"
    assert read.validation == VAL
    change(raw / "metadata.json", **{VAL[1]: {"camera_id": 1}})
    with pytest.raises(
        DatasetError, match=r"has no splits/, and dataset.json and metadata.json do not tell.*'warp_id'"
    ):
        read_sequence(raw, "dycheck")


def test_times_decide_the_order_and_the_fitted_picture(raw: Path) -> None:
    """Training pictures go by time; a validation picture, in the order of the file, with the nearest one's time."""
    change(raw / "splits" / "train.json", frame_names=["0_00009", "0_00002", "0_00004"], time_ids=[9, 2, 4])
    change(raw / "splits" / "val.json", frame_names=["2_00010", "1_00000", "1_00005"], time_ids=[10, 0, 5])
    read = read_sequence(raw, "dycheck")
    assert read.names == ("0_00002", "0_00004", "0_00009")
    assert read.validation == ("2_00010", "1_00000", "1_00005")
    assert read.frames == (2, 0, 1)


def test_colours_that_lidar_missed_are_not_black(raw: Path) -> None:
    path = raw / "rgb" / "2x" / "0_00003.png"
    picture = bgra(path)
    whole = picture[..., 2::-1].copy()
    picture[10:13, 20:23] = 0
    cv2.imwrite(str(path), picture)
    rgb = read_sequence(raw, "dycheck").view.rgb[3].numpy()
    hole = np.zeros(rgb.shape[:2], bool)
    hole[10:13, 20:23] = True
    assert (rgb[~hole] == whole[~hole]).all()
    assert (rgb[[11, 10], [20, 21]] == whole[[11, 9], [19, 21]]).all()  # of the nearest pixels, beside and above
    validation = raw / "rgb" / "2x" / f"{VAL[0]}.png"
    picture = bgra(validation)
    picture[10:12, 20:23, 3] = 0
    cv2.imwrite(str(validation), picture)
    true = read_sequence(raw, "dycheck").true_picture(VAL[0])
    assert (true == picture[..., 2::-1]).all()  # what is scored does not go by alpha


@pytest.mark.parametrize("shape", [(30, 40, 1), (30, 40)])
def test_lidar_depth_is_in_metres_and_0_where_unknown(raw: Path, shape: tuple[int, ...]) -> None:
    for i in range(FRAMES):
        depth = np.full(shape, 0.5 + 0.1 * i, np.float32)
        depth[:5] = 0
        np.save(raw / "depth" / "2x" / f"0_{i:05d}.npy", depth)
    read = read_sequence(raw, "dycheck").view.depth
    assert read is not None
    assert (read[:, :5] == 0).all()
    torch.testing.assert_close(read[:, 5:].mean((1, 2)), 0.5 + 0.1 * torch.arange(FRAMES))


def test_scene_scale_is_for_other_loaders(raw: Path) -> None:
    """scene.json and extra.json bring all that camera 0 saw into a box of diagonal 1; what is read stays in metres."""
    before = read_sequence(raw, "dycheck")
    scene, extra = (json.loads((raw / name).read_text()) for name in ("scene.json", "extra.json"))
    low, high = np.array(extra["bbox"])
    np.testing.assert_allclose(low, -high, atol=1e-9)
    assert np.linalg.norm(high - low) == pytest.approx(1)
    assert before.view.depth is not None
    assert scene["near"] < scene["scale"] * float(before.view.depth.min()) < scene["far"]
    places = before.view.camera.world_from_camera[:, :3, 3].numpy()
    own = (places - np.array(scene["center"])) * scene["scale"]
    assert ((own >= low - 1e-6) & (own <= high + 1e-6)).all()
    change(raw / "scene.json", scale=0.01, center=[5.0, 5.0, 5.0])
    after = read_sequence(raw, "dycheck")
    assert torch.equal(after.cameras.world_from_camera, before.cameras.world_from_camera)


@pytest.mark.parametrize("protocol", ["dycheck", "som"])
def test_covisible_masks_are_weights(packaged: Path, protocol: Protocol) -> None:
    """Grey or the first channel of a picture, over 255; of each protocol its own file, named like the picture."""
    factor, folder = (2, "covisible/2x/val") if protocol == "dycheck" else (1, f"{PACKAGE}/covisible/1x/val")
    mask = np.zeros((HEIGHT // factor, WIDTH // factor), np.uint8)
    mask[:5], mask[5:8] = 255, 51
    colours = np.dstack((np.full_like(mask, 7), np.full_like(mask, 9), mask))  # OpenCV writes the last as the first
    for name, written in ((VAL[1], mask), (VAL[2], colours)):
        cv2.imwrite(str(packaged / folder / f"{name}.png"), written)
        read = read_sequence(packaged, protocol).covisible(name)
        assert read[0, 0] == 1
        assert read[6, 3] == pytest.approx(0.2)
        assert not read[8:].any()


def test_masks_and_depth_of_the_package(packaged: Path) -> None:
    """A mask says what moves above one half; depth is one over a disparity of at least 1e-3, in the cameras' unit."""
    folder = packaged / PACKAGE
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:10], mask[10:20], mask[20:30] = 255, 128, 127
    cv2.imwrite(str(folder / "track_anything" / "1x" / "0_00002.png"), mask)
    for i in range(FRAMES):
        disparity = np.full((HEIGHT, WIDTH), 0.5, np.float32)
        disparity[:30] = 0.25
        if i == 4:
            disparity[0] = 0.0
        np.save(folder / "aligned_depth_anything_colmap" / "1x" / f"0_{i:05d}.npy", disparity)
    np.save(folder / "colmap" / "scale.npy", np.array(0.3))
    priors = read_priors(read_sequence(packaged, "som"), WIDTH)
    assert priors.masks is not None
    assert priors.depth is not None
    assert (priors.masks[2].any(axis=1).nonzero()[0] == np.arange(20)).all()
    assert priors.depth[3, 50] == pytest.approx(0.3 * 2)
    assert priors.depth[3, 10] == pytest.approx(0.3 * 4)
    assert priors.depth[4, 0] == pytest.approx(0.3 * 2.5 * 4)  # of the median over frames of the farthest


def test_tracks_of_the_package(packaged: Path) -> None:
    """<asked for>_<looked at>.npy; the first pixel's centre is at 0; seen where neither logit says otherwise."""
    folder = packaged / PACKAGE / "2d_tracks" / "1x"
    for query in range(FRAMES):
        for other in range(FRAMES):
            rows = [[query, other, -9.0, -9.0], [3.0, 4.0, 9.0, -9.0], [3.0, 4.0, -9.0, 9.0], [3.0, 4.0, -0.5, -0.5]]
            np.save(folder / f"0_{query:05d}_0_{other:05d}.npy", np.array(rows, np.float32))
    priors = read_priors(read_sequence(packaged, "som"), WIDTH)
    assert priors.tracks is not None
    assert priors.vis is not None
    assert priors.query_t is not None
    assert (priors.query_t == np.repeat(np.arange(FRAMES), 4)).all()
    first = priors.tracks[::4]
    assert (first[..., 0] == np.arange(FRAMES)[:, None] + 0.5).all()
    assert (first[..., 1] == np.arange(FRAMES) + 0.5).all()
    assert (priors.vis[:4] == np.array([True, False, False, False])[:, None]).all()  # 0.62 times 0.62 is less
