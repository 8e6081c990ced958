"""From a video to its scenes and new pictures, also where the video is not as one would wish."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_msdyn.augment.episode import by_feature
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import EpisodeError
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.priors import Priors, estimate_priors
from lerobot_msdyn.reconstruction import reconstruct as pipeline
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.views.pictures import Picture, new_pictures

pytestmark = pytest.mark.slow

FRAMES, WIDTH, HEIGHT = 12, 64, 48


@pytest.fixture(scope="module")
def pushed() -> View:
    scene = make_scene("push", 0, FRAMES, WIDTH, HEIGHT)
    seen = scene.render(scene.camera)
    return View(seen.rgb, scene.camera, seen.depth)


@pytest.fixture
def restore_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def recipe(steps: int = 10) -> Recipe:
    found = Recipe()
    found.fit.steps = steps
    return found


def some(view: View, frames: list[int]) -> View:
    """Some frames of a video, also repeated."""
    depth = None if view.depth is None else view.depth[frames]
    return View(view.rgb[frames], view.camera.select(frames), depth)


def check(view: View, settings: Recipe) -> None:
    """Every frame can be drawn, and looks about like the recorded one from the recorded camera."""
    pictures = list(new_pictures(reconstruct(view, settings), view.camera))
    assert len(pictures) == len(view.rgb)
    for picture, recorded in zip(pictures, view.rgb, strict=True):
        assert picture.rgb.shape == (HEIGHT, WIDTH, 3)
        assert abs(picture.rgb.astype(int) - recorded.numpy()).mean() < 40
        assert torch.isfinite(torch.from_numpy(picture.depth)).all()


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_very_short_videos(pushed: View, frames: int) -> None:
    check(some(pushed, list(range(frames))), recipe())


def test_nothing_moves(pushed: View) -> None:
    check(some(pushed, [3] * FRAMES), recipe())


def test_everything_moves(pushed: View) -> None:
    rolled = torch.stack([image.roll(5 * t, dims=1) for t, image in enumerate(pushed.rgb)])
    check(dataclasses.replace(pushed, rgb=rolled), recipe())


def test_a_frozen_stretch(pushed: View) -> None:
    check(some(pushed, [0, 1, 2, 3, 3, 3, 3, 3, 4, 5, 6, 7]), recipe())


def test_a_black_stretch(pushed: View) -> None:
    rgb = pushed.rgb.clone()
    rgb[4:7] = 0
    pictures = list(new_pictures(reconstruct(dataclasses.replace(pushed, rgb=rgb), recipe()), pushed.camera))
    assert len(pictures) == FRAMES


def test_a_cut(pushed: View) -> None:
    rgb = pushed.rgb.clone()
    rgb[6:] = rgb[6:].flip(2)
    pictures = list(new_pictures(reconstruct(dataclasses.replace(pushed, rgb=rgb), recipe()), pushed.camera))
    assert len(pictures) == FRAMES


@pytest.mark.parametrize("scale", [0.01, 0.1, 30.0])
def test_depth_of_the_wrong_scale(pushed: View, scale: float) -> None:
    assert pushed.depth is not None
    check(dataclasses.replace(pushed, depth=pushed.depth * scale), recipe())


def test_unmeasured_depth(pushed: View) -> None:
    assert pushed.depth is not None
    depth = pushed.depth.clone()
    depth[2:5] = torch.nan
    depth[7, :20] = torch.inf
    depth[9] = 0
    check(dataclasses.replace(pushed, depth=depth), recipe())


@pytest.mark.parametrize("lost", ["from the middle on", "at every other frame", "all"])
def test_lost_tracks(pushed: View, monkeypatch: pytest.MonkeyPatch, lost: str) -> None:
    def estimated(*arguments: Any, **named: Any) -> Priors:
        priors = estimate_priors(*arguments, **named)
        visible = priors.tracks.visible.clone()
        gone = {"from the middle on": slice(FRAMES // 2, None), "at every other frame": slice(0, None, 2)}
        visible[:, gone.get(lost, slice(None))] = False
        return dataclasses.replace(priors, tracks=dataclasses.replace(priors.tracks, visible=visible))

    monkeypatch.setattr(pipeline, "estimate_priors", estimated)
    check(pushed, recipe())


def test_windows_whose_priors_differ_say_so(pushed: View, monkeypatch: pytest.MonkeyPatch) -> None:
    def estimated(view: View, **named: Any) -> Priors:
        priors, metric = estimate_priors(view, **named), torch.equal(view.rgb[0], pushed.rgb[0])
        depth = {"provider": "recorded" if metric else "plane", "why": "of this test"}
        traits = DepthTraits(metric=metric)
        return dataclasses.replace(priors, depth_traits=traits, provenance=priors.provenance | {"depth": depth})

    monkeypatch.setattr(pipeline, "estimate_priors", estimated)
    settings = recipe()
    settings.fit.window_frames = 6
    found = reconstruct(pushed, settings)
    assert found.provenance["depth"] == {"provider": "recorded; plane", "why": "of this test"}
    assert found.provenance["masks"]["provider"] == "change"
    assert not found.metric


def test_windows_show_the_same_where_nothing_moves(pushed: View) -> None:
    settings = recipe(steps=30)
    settings.fit.window_frames = 6
    first, second = (window.scene for window in reconstruct(pushed, settings).windows)
    assert (first.static.means == second.static.means).all(-1).float().mean() > 0.7
    assert (first.static.sh == second.static.sh).flatten(1).all(-1).float().mean() > 0.7


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_windows_do_not_depend_on_how_many_are_worked_on_at_once(
    pushed: View, threads: int, restore_threads: None
) -> None:
    settings = recipe()
    settings.fit.window_frames = 5
    torch.set_num_threads(1)
    expected = reconstruct(pushed, settings)
    torch.set_num_threads(threads)
    for one, other in zip(reconstruct(pushed, settings).windows, expected.windows, strict=True):
        assert one.start == other.start
        for name, tensor in one.scene.tensors().items():
            assert torch.equal(tensor, other.scene.tensors()[name]), name


@pytest.mark.parametrize("step", ["priors", "fit", "overlay"])
def test_a_fault_in_one_window_ends_the_others(pushed: View, step: str, restore_threads: None) -> None:
    done: list[int] = []

    def broken(draft: pipeline.Draft) -> None:
        done.append(draft.start)
        if draft.start == 0:
            raise EpisodeError("of this test")
        pipeline.STEPS[step](draft)

    settings = recipe()
    settings.fit.window_frames = 2
    torch.set_num_threads(2)
    with pytest.raises(EpisodeError, match="of this test"):
        reconstruct(pushed, settings, steps=pipeline.with_steps({step: broken}))
    assert len(done) <= 3  # of six windows


def test_a_long_video_is_fitted_in_windows(pushed: View) -> None:
    settings = recipe()
    settings.fit.window_frames = 5
    found = reconstruct(pushed, settings)
    assert [window.start for window in found.windows] == [0, 4, 8]
    assert [window.scene.frames for window in found.windows] == [4, 4, 4]
    check(pushed, settings)
    frames = torch.tensor([7, 0, 9])
    whole = list(new_pictures(found, pushed.camera))
    for picture, frame in zip(new_pictures(found, pushed.camera.select(frames), frames), frames, strict=True):
        assert abs(picture.rgb.astype(int) - whole[int(frame)].rgb).max() <= 1


def test_depth_is_rendered_where_it_is_recorded_and_wanted(desk: Path) -> None:
    source, key = open_source("local/desk", desk), "observation.images.front"
    picture = Picture(
        np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.ones((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), bool)
    )
    for depth, features in ((True, [key, f"{key}_depth"]), (False, [key])):
        assert [list(found) for found in by_feature(source, {key: iter([picture])}, depth=depth)] == [features]
