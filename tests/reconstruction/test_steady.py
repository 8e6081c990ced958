"""A camera that was moved: the video is cut, or brought back to one place."""

import numpy as np
import pytest
import torch
from panned import HEIGHT, WIDTH, along, panned

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.reconstruction.windows import Window, stands_of, whole_stands

FRAMES = 24
DRIFT = along((FRAMES, 0.5))


def recipe() -> Recipe:
    found = Recipe()
    found.priors.cache = "off"
    return found


def view(shifts: np.ndarray) -> View:
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), len(shifts), WIDTH, HEIGHT)
    return View(panned(shifts, noise=0.5), camera, torch.full((len(shifts), HEIGHT, WIDTH), 1.5))


def windows_of(video: View, settings: Recipe) -> list[Window]:
    return whole_stands(video, stands_of(video, settings))


def test_no_window_spans_a_step() -> None:
    video = view(along((10, 0), (1, 8.0), (13, 0)))
    first, second = windows_of(video, recipe())
    assert (first.start, len(first.view), second.start, len(second.view)) == (0, 10, 10, 14)
    for window in (first, second):
        assert torch.equal(window.steady(WIDTH).rgb, window.view.rgb)  # nothing is resampled
        spread = window.few_frames(WIDTH).rgb.float().std(0).mean()
        assert float(spread) < 1


def test_a_drift_is_undone() -> None:
    video = view(DRIFT)
    (window,) = windows_of(video, recipe())
    steady = window.steady(WIDTH)
    inside = slice(3, -3)
    assert float(video.rgb[:, inside, inside].float().std(0).mean()) > 10
    assert float(steady.rgb[:, inside, inside].float().std(0).mean()) < 3
    assert float(steady.rgb.float().std(0).mean()) < 4  # beyond the edges, what other frames show
    assert steady.depth is not None
    assert set(steady.depth.unique().tolist()) == {0.0, 1.5}
    assert float((steady.depth == 0).float().mean()) < 0.04
    few = window.few_frames(WIDTH // 2)
    assert few.rgb.shape == (20, HEIGHT // 2, WIDTH // 2, 3)
    assert float(few.rgb.float().std(0).mean()) < 4


def test_a_steady_video_stays_as_it_is() -> None:
    video = view(np.zeros((FRAMES, 2)))
    (window,) = windows_of(video, recipe())
    assert window.path is None
    assert window.steady(WIDTH).rgb is video.rgb or torch.equal(window.steady(WIDTH).rgb, video.rgb)


@pytest.mark.parametrize("why", ["masks from a file", "poses that vary"])
def test_what_is_known_of_the_whole_video_is_not_cut(why: str) -> None:
    video, settings = view(along((10, 0), (1, 8.0), (13, 0))), recipe()
    if why == "masks from a file":
        settings.priors.masks = "FILE.npz"
    else:
        video.camera.world_from_camera[5, 0, 3] = 0.1
    (window,) = windows_of(video, settings)
    assert len(window.view) == FRAMES


def test_a_camera_that_moves_is_left_as_recorded() -> None:
    video = view(along((40, 3.0)))
    stands = stands_of(video, recipe())
    assert stands.moves
    (window,) = whole_stands(video, stands)
    assert window.path is None
