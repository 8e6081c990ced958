"""What episodes share is made once: it is found again on disk, unless something that it depends on has changed."""

from pathlib import Path

import pytest
import torch

from lerobot_msdyn.augment import backgrounds
from lerobot_msdyn.augment.backgrounds import shared_backgrounds
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.dataset.read import open_source, read_episode
from lerobot_msdyn.reconstruction import share_background as sharing
from lerobot_msdyn.reconstruction.windows import Window, windows

FRONT = "observation.images.front"


def recipe(cache: Path) -> Recipe:
    found = Recipe()
    found.fit.steps = 4
    found.priors.cache = str(cache)
    return found


def test_a_background_is_fitted_once(desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, settings = open_source("local/desk", desk), recipe(tmp_path)
    (first,) = shared_backgrounds(source, [FRONT], settings)[FRONT]
    asked = []

    def nothing_moves(*arguments: object) -> torch.Tensor:
        asked.append(arguments)
        return torch.zeros(12, 48, 64, dtype=torch.uint8)

    monkeypatch.setattr(backgrounds, "moving_in_few", nothing_moves)
    (again,) = shared_backgrounds(source, [FRONT], settings)[FRONT]
    assert asked == []
    assert first.static is not None
    assert again.static is not None
    assert torch.equal(again.static.means, first.static.means)
    assert torch.equal(again.frames, first.frames)
    settings.fit.steps = 6
    shared_backgrounds(source, [FRONT], settings)
    assert len(asked) == 3


def test_an_episode_without_masks_is_left_out(desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*arguments: object, **named: object) -> None:
        raise PriorError("no masks of this episode")

    monkeypatch.setattr(sharing, "estimate_masks", refused)
    (found,) = shared_backgrounds(open_source("local/desk", desk), [FRONT], recipe(tmp_path))[FRONT]
    assert found.empty.seen.max() == 0
    assert found.static is None


def test_windows_are_of_about_equal_length(desk: Path, tmp_path: Path) -> None:
    settings = recipe(tmp_path)
    settings.fit.window_frames = 5
    view = read_episode(open_source("local/desk", desk), 0, [FRONT], settings.camera).views[FRONT]
    parts = windows(Window(0, view), settings)
    assert [part.start for part in parts] == [0, 4, 8]
    assert [len(part.view) for part in parts] == [4, 4, 4]
    settings.priors.masks = "FILE.npz"  # is for the whole video
    assert len(windows(Window(0, view), settings)) == 1
