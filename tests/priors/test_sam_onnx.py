"""Segment Anything in files of ONNX: what is shown, what is taken of the answers, and one line for what is wrong."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors import estimate_priors
from lerobot_msdyn.priors.estimate import check_named_providers
from lerobot_msdyn.priors.masks.refined import refined

WIDTH, HEIGHT, FRAMES = 64, 48, 16
REAL = "LEROBOT_MSDYN_TEST_SAM"  # names a folder with real networks


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Networks that mean what is bright."""
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    from tiny_sam import save_sam

    return save_sam(tmp_path / "sam")


def loaded(folder: Path):
    from lerobot_msdyn.priors.masks.sam_onnx import SamNetworks

    return SamNetworks(folder, "cpu")


def thing() -> np.ndarray:
    """A square's pixels."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[12:36, 20:44] = True
    return mask


def pictures(count: int = FRAMES) -> np.ndarray:
    """The square is red and bright, all else is dark."""
    image = np.full((HEIGHT, WIDTH, 3), 20, np.uint8)
    image[thing(), 0] = 240
    return np.repeat(image[None], count, axis=0)


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


class Bright:
    """Means what is bright, or the mask itself where nothing is."""

    def encoded(self, frame: np.ndarray) -> np.ndarray:
        return frame[None, None, ..., 0].astype(np.float32) - 128

    def answer(self, embedding: np.ndarray, mask: np.ndarray, *, whole: bool = False) -> np.ndarray:
        return embedding[0, 0]


class Everything(Bright):
    def answer(self, embedding: np.ndarray, mask: np.ndarray, *, whole: bool = False) -> np.ndarray:
        return np.ones(mask.shape, np.float32)


@pytest.mark.parametrize("whole", [False, True])
def test_what_is_meant_is_found_in_its_place(folder: Path, whole: bool) -> None:
    network = loaded(folder)
    frame = pictures()[0]
    mask = thing()
    mask[:, 30:] = False
    answer = network.answer(network.encoded(frame), mask, whole=whole) > 0
    assert iou(answer, thing()) > 0.9


def test_colours_arrive_as_stated(folder: Path) -> None:
    frame = pictures()[0][..., ::-1].copy()  # the square is blue
    rgb = loaded(folder)
    assert not (rgb.answer(rgb.encoded(frame), thing(), whole=True) > 0)[thing()].any()
    (folder / "sam.yaml").write_text("channels: bgr")
    bgr = loaded(folder)
    assert iou(bgr.answer(bgr.encoded(frame), thing(), whole=True) > 0, thing()) > 0.9


def test_a_thing_that_rests_is_whole_where_its_mask_lost_a_part() -> None:
    instances = np.repeat(7 * thing().astype(np.uint8)[None], FRAMES, axis=0)
    instances[5:, :, 36:] = 0
    out = refined(pictures(), instances, Bright())
    assert set(np.unique(out)) == {0, 7}
    assert all(iou(frame == 7, thing()) > 0.95 for frame in out)


def test_what_moves_keeps_its_mask_where_the_network_contradicts() -> None:
    instances = np.zeros((FRAMES, HEIGHT, WIDTH), np.uint8)
    for frame in range(FRAMES):
        instances[frame, 10:20, 2 * frame : 2 * frame + 20] = 1
    for network in (Everything(), Bright()):
        np.testing.assert_array_equal(refined(pictures(), instances, network), instances)


@pytest.mark.parametrize("count", [1, 2, 6])
def test_short_clips_and_nothing_that_moves(count: int) -> None:
    assert not refined(pictures(count), np.zeros((count, HEIGHT, WIDTH), np.uint8), Bright()).any()
    out = refined(pictures(count), np.repeat(thing().astype(np.uint8)[None], count, axis=0), Bright())
    np.testing.assert_array_equal(out > 0, np.repeat(thing()[None], count, axis=0))


def test_the_provider_outlines_what_was_found_without_weights(folder: Path) -> None:
    (folder / "sam.yaml").write_text("model: tiny\nlicence: MIT\n")
    rgb = torch.full((FRAMES, HEIGHT, WIDTH, 3), 20, dtype=torch.uint8)
    for frame in range(FRAMES):
        rgb[frame, 12:32, 2 * frame : 2 * frame + 20, 0] = 240
    view = View(rgb, static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT))
    config = PriorsConfig(depth="plane", masks=f"onnx:{folder}", tracks="flow", cache="off")
    check_named_providers(config, CameraConfig(), "cpu")
    priors = estimate_priors(view, config, CameraConfig())
    assert iou((priors.instances > 0).numpy(), (rgb[..., 0] > 100).numpy()) > 0.8
    entry = priors.provenance["masks"]
    assert (entry["provider"], entry["model"], entry["licence"]) == ("onnx", "tiny", "MIT")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("two.onnx", b"no network", r"two\.onnx is no network that onnxruntime can load"),
        ("two.onnx", None, r"sam holds networks: one that takes picture; expected two, an encoder that takes a pict"),
        ("sam.yaml", b"meen: [0, 0, 0]", r"sam\.yaml: unknown key 'meen'; did you mean 'mean'"),
        ("sam.yaml", b"std: [0, 1, 1]", r"sam\.yaml: std has a 0"),
    ],
)
def test_a_wrong_folder_is_named_in_one_line(folder: Path, name: str, content: bytes | None, message: str) -> None:
    (folder / name).unlink(missing_ok=True)
    if content is not None:
        (folder / name).write_bytes(content)
    with pytest.raises(MsdynError, match=message) as caught:
        check_named_providers(PriorsConfig(masks=f"onnx:{folder}"), CameraConfig(), "cpu")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        ("onnx", r"priors.masks is 'onnx'; expected onnx:FOLDER"),
        ("onnx:/absent/sam", r"priors.masks is 'onnx:/absent/sam', but there is no folder /absent/sam"),
    ],
)
def test_a_wrong_choice_is_named_in_one_line(masks: str, message: str) -> None:
    pytest.importorskip("onnxruntime")
    with pytest.raises(MsdynError, match=message):
        check_named_providers(PriorsConfig(masks=masks), CameraConfig(), "cpu")


@pytest.mark.slow
@pytest.mark.skipif(REAL not in os.environ, reason=f"{REAL} names no folder with real networks")
def test_real_networks_outline_a_thing_by_a_part_of_it() -> None:
    network = loaded(Path(os.environ[REAL]))
    part = thing()
    part[:, 34:] = False
    embedding = network.encoded(pictures()[0])
    assert iou(network.answer(embedding, part, whole=True) > 0, thing()) > 0.9
    assert iou(network.answer(embedding, thing()) > 0, thing()) > 0.9
