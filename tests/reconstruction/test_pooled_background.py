"""Several episodes of one camera: what each hides is taken from the others, in its own colours."""

import dataclasses

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.reconstruction.background import EmptyScene, background_gaussians, empty_scene
from lerobot_msdyn.reconstruction.pooled_background import (
    MovingIn,
    SharedBackground,
    adapted,
    as_arrays,
    colour_match,
    completed,
    continued,
    differing,
    exchanged,
    from_arrays,
    pooled,
    same_places,
    shift_px,
)

WIDTH, HEIGHT, FRAMES = 64, 48, 9


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(40, 200, (HEIGHT // 4, WIDTH // 4, 3)).astype(np.uint8)
    return noise.repeat(4, 0).repeat(4, 1)


def episode(block_column: int, wall: np.ndarray, shift: int = 0) -> View:
    """A block that rests before a textured wall for the whole episode."""
    picture = np.roll(wall, shift, axis=1).copy()
    picture[20:28, block_column : block_column + 8] = (250, 20, 20)
    rgb = torch.from_numpy(picture).expand(FRAMES, -1, -1, -1).contiguous()
    depth = torch.full((FRAMES, HEIGHT, WIDTH), 2.0)
    depth[:, 20:28, block_column : block_column + 8] = 1.5
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    return View(rgb, camera, depth)


def moving(views: list[View], wall: np.ndarray) -> MovingIn:
    """The block."""
    return lambda numbers, frames: [
        (views[number].rgb != torch.from_numpy(wall)).any(-1).to(torch.uint8) for number in numbers
    ]


def shared_by(views: list[View], wall: np.ndarray) -> list[SharedBackground]:
    return [pooled([views[i] for i in group], group, moving(views, wall)) for group in same_places(views)]


def test_what_moves_is_no_background_though_most_episodes_show_it_at_the_same_place() -> None:
    wall = texture()
    (shared,) = shared_by([episode(column, wall) for column in (20, 20, 20, 52)], wall)
    assert (shared.empty.rgb.numpy() == wall).mean() > 0.99
    assert (shared.empty.depth == 2).all()
    assert shared.frames.shape == (4 * FRAMES, HEIGHT, WIDTH, 3)
    assert shared.fits(episode(30, wall))


def test_a_camera_that_was_moved_has_its_own_background() -> None:
    wall = texture()
    views = [
        episode(4, wall),
        episode(20, wall),
        episode(4, wall, shift=6),
        episode(36, wall, shift=6),
        episode(4, texture(1)),
    ]
    nothing = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    found = [
        pooled([views[i] for i in group], group, lambda numbers, _: [nothing for _ in numbers])
        for group in same_places(views)
    ]
    assert len(found) == 2
    assert [group.fits(views[0]) for group in found] == [True, False]
    assert [group.fits(views[2]) for group in found] == [False, True]


def test_a_moving_camera_shares_nothing() -> None:
    view = episode(4, texture())
    poses = view.camera.world_from_camera.clone()
    poses[3:, 0, 3] = 0.2
    swaying = dataclasses.replace(view, camera=dataclasses.replace(view.camera, world_from_camera=poses))
    (shared,) = shared_by([view, episode(20, texture()), swaying, swaying], texture())
    assert not shared.fits(swaying)


def test_only_what_an_episode_never_shows_is_taken_from_others_and_in_its_colours() -> None:
    wall = texture()
    seen = torch.full((HEIGHT, WIDTH), 20)
    everywhere = EmptyScene(torch.from_numpy(wall), torch.full((HEIGHT, WIDTH), 2.0), seen)
    darker = torch.from_numpy((0.8 * wall + 10).round().astype(np.uint8))
    hidden = (slice(10, 20), slice(10, 30))
    own_picture, own_seen, own_depth = darker.clone(), seen.clone(), torch.full((HEIGHT, WIDTH), 2.02)
    own_picture[hidden], own_seen[hidden], own_depth[hidden] = 0, 0, 0
    whole = completed(EmptyScene(own_picture, own_depth, own_seen), everywhere, 60)
    assert (whole.rgb.int() - darker.int()).abs().max() <= 1
    assert (whole.depth[hidden] == 2).all()
    assert (whole.depth == 2.02).sum() == HEIGHT * WIDTH - 200
    assert (whole.seen >= 20).all()
    nothing_missing = EmptyScene(darker, own_depth, seen)
    assert completed(nothing_missing, everywhere, 60) is nothing_missing


def test_what_an_episode_shows_otherwise_counts_only_if_it_does_so_for_long() -> None:
    wall = texture()
    place = (slice(10, 20), slice(10, 30))
    everywhere = EmptyScene(torch.from_numpy(wall), torch.full((HEIGHT, WIDTH), 2.0), torch.full((HEIGHT, WIDTH), 60))
    for frames, kept in ((5, False), (30, True)):
        picture, seen = torch.from_numpy(wall).clone(), torch.full((HEIGHT, WIDTH), 60)
        picture[place], seen[place] = 250, frames
        found = completed(EmptyScene(picture, everywhere.depth, seen), everywhere, 100)
        assert torch.equal(found.rgb, picture) == kept
        assert torch.equal(found.rgb, everywhere.rgb) != kept


def test_colours_are_matched_in_spite_of_things_that_differ() -> None:
    wall, seen = texture(), torch.ones(HEIGHT, WIDTH, dtype=torch.long)
    like = (0.9 * wall + 5).round().astype(np.uint8)
    like[:12] = 255
    shared, own = (EmptyScene(torch.from_numpy(image), torch.ones(HEIGHT, WIDTH), seen) for image in (wall, like))
    found = colour_match(shared, own).applied(shared.rgb).numpy()
    assert np.abs(found[12:].astype(int) - like[12:]).max() <= 2


def test_an_episode_keeps_its_own_gaussians_where_its_background_is_another() -> None:
    view = episode(4, texture())
    (shared,) = shared_by([view, episode(20, texture()), episode(40, texture())], texture())
    static = background_gaussians(shared.empty.rgb, shared.empty.depth, view.camera, 10_000)
    shared = dataclasses.replace(shared, static=dataclasses.replace(static, means=static.means + 1))  # to tell them
    assert view.depth is not None
    own = empty_scene(view.rgb, view.depth, torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8))
    fresh = background_gaussians(own.rgb, own.depth, view.camera, 10_000)
    mixed = adapted(shared, own, fresh).means.reshape(HEIGHT, WIDTH, 3)
    mine = (mixed == fresh.means.reshape(HEIGHT, WIDTH, 3)).all(-1)
    assert mine[20:28, 4:12].all()
    assert mine.sum() <= 12 * 12


def test_a_later_window_shows_what_the_first_one_does_but_where_it_differs() -> None:
    """Shadows and exposure are left to the brightness over time; another surface, and what was hidden, are its own."""
    wall = texture()
    depth, seen = torch.full((HEIGHT, WIDTH), 2.0), torch.full((HEIGHT, WIDTH), 60)
    hidden = seen.clone()
    hidden[:4, :4] = 0
    first = EmptyScene(torch.from_numpy(wall), depth, hidden)
    darker = torch.from_numpy((0.95 * wall).astype(np.uint8))
    other = darker.clone()
    other[20:28, 4:12] = 255
    own = EmptyScene(other, depth, seen)
    differs = differing(first, own)
    assert differs[20:28, 4:12].all()
    assert differs[:4, :4].all()
    assert differs.sum() <= 12 * 12 + 6 * 6
    whole = continued(first, own, differs)
    assert torch.equal(whole.rgb[differs], own.rgb[differs])
    assert torch.equal(whole.rgb[~differs], first.rgb[~differs])
    assert (whole.seen == 60).all()


def test_gaussians_are_exchanged_by_pixel() -> None:
    view = episode(4, texture())
    rgb, depth = torch.from_numpy(texture()), torch.full((HEIGHT, WIDTH), 2.0)
    mine = background_gaussians(rgb, depth, view.camera, 10_000)
    others = dataclasses.replace(mine, means=mine.means + 1)
    where = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    where[3, 5] = True
    found = exchanged(mine, others, where)
    assert (found.means - mine.means).reshape(HEIGHT, WIDTH, 3)[3, 5].tolist() == [1, 1, 1]
    assert int((found.means != mine.means).any(-1).sum()) == 1
    with pytest.raises(ValueError, match="expected"):
        exchanged(mine.select(slice(0, 7)), others, where)


@pytest.mark.parametrize("shift", [0, 3])
def test_shift_between_pictures(shift: int) -> None:
    wall = texture()
    assert shift_px(wall, np.roll(wall, shift, axis=1)) == pytest.approx(shift, abs=0.3)


def test_pictures_of_different_sizes_are_of_different_cameras() -> None:
    assert shift_px(texture(), texture()[:20]) == float("inf")


def test_black_bars_do_not_hide_that_a_camera_was_moved() -> None:
    wall = texture()
    views = [episode(4, wall), episode(20, wall), episode(36, wall, shift=6), episode(4, wall, shift=6)]
    for view in views:
        view.rgb[:, :8], view.rgb[:, -8:] = 0, 0
    assert same_places(views) == [[0, 1], [2, 3]]


def test_a_background_comes_back_from_its_arrays() -> None:
    view = episode(4, texture())
    (shared,) = shared_by([view, episode(20, texture())], texture())
    static = background_gaussians(shared.empty.rgb, shared.empty.depth, view.camera, 10_000)
    for known in (shared, dataclasses.replace(shared, static=static)):
        again = from_arrays(as_arrays(known), known.camera, known.frames)
        assert torch.equal(again.empty.rgb, known.empty.rgb)
        assert (again.static is None) == (known.static is None)
        if again.static is not None:
            assert torch.equal(again.static.sh, static.sh)
