"""Flashes: what is bright for one frame only is noticed, what moves is not."""

import numpy as np
import pytest

from lerobot_msdyn.core.config import GateConfig
from lerobot_msdyn.views.flashes import FLOOR, Flash, Flashes, largest_flash, too_large
from lerobot_msdyn.views.pictures import Picture

FRAMES, WIDTH, HEIGHT = 12, 160, 120


def video() -> np.ndarray:
    """A bright square that moves by its own width in six frames."""
    pictures = np.full((FRAMES, HEIGHT, WIDTH, 3), 60, np.uint8)
    for frame in range(FRAMES):
        pictures[frame, 40:88, 8 + 8 * frame : 56 + 8 * frame] = 220
    return pictures


@pytest.mark.parametrize("colour", [255, 0])
def test_a_line_along_the_border_of_one_frame(colour: int) -> None:
    pictures = video()
    assert largest_flash(pictures).size < 0.01
    pictures[7, :, -4:] = colour
    found = largest_flash(pictures)
    assert found.frame == 7
    assert found.size == pytest.approx(abs(colour - 60) / 255 / 2, abs=0.01)  # half of a cell of 8 px


def test_a_step_that_stays_is_none() -> None:
    pictures = video()
    pictures[5:, :20] = 200
    assert largest_flash(pictures).size < 0.01


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_too_short_for_a_flash(frames: int) -> None:
    assert largest_flash(video()[:frames]) == Flash()


def test_pictures_pass_by() -> None:
    pictures, flashes = video(), Flashes()
    pictures[3, :30, :40] = 255
    depth, unseen = np.zeros((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), bool)
    passed = list(flashes.kept("front", (Picture(rgb, depth, unseen) for rgb in pictures)))
    assert [picture.rgb.tobytes() for picture in passed] == [rgb.tobytes() for rgb in pictures]
    assert flashes.largest("front") == largest_flash(pictures)
    assert flashes.largest("front").frame == 3


def test_a_view_may_flash_as_its_video_does() -> None:
    config = GateConfig()
    assert too_large(Flash(3, FLOOR), Flash(), config) == ""
    assert too_large(Flash(3, 0.5), Flash(8, 0.3), config) == ""
    why = too_large(Flash(3, 0.71), Flash(8, 0.3), config)
    assert why.startswith("frame 3 flashes by 0.71 of the brightness range, the recording by 0.30 at most")
    assert "gate.max_flash_ratio 2" in why
