"""Episodes of a camera that moves, with poses in one world: what one never shows is taken from another."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from walking import FRAMES, HEIGHT, WIDTH, walk_along

from lerobot_msdyn.core.cameras import static_camera
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.core.serialise import load_value, save_value
from lerobot_msdyn.evaluate.metrics import masked_psnr_db
from lerobot_msdyn.priors.exchange import Exchange, write_exchange
from lerobot_msdyn.reconstruction import share_background
from lerobot_msdyn.reconstruction.key_views import KeyView, key_views
from lerobot_msdyn.reconstruction.reconstruct import Draft, reconstruct, with_steps
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.reconstruction.share_background import shown_by
from lerobot_msdyn.reconstruction.shown_elsewhere import Shown, with_shown
from lerobot_msdyn.synthetic.scene import SyntheticScene
from lerobot_msdyn.synthetic.viewpoints import walking_camera
from lerobot_msdyn.views.pictures import Picture, new_pictures

LEFT, RIGHT = (-25.0, -5.0), (-10.0, 15.0)  # degrees of azimuth

Walked = tuple[SyntheticScene, View, Priors]


@pytest.fixture(scope="module")
def here() -> Walked:
    return walk_along(LEFT)


@pytest.fixture(scope="module")
def keys(here: Walked) -> tuple[KeyView, ...]:
    return key_views(*here[1:])


@pytest.fixture(scope="module")
def there() -> Shown:
    """What another episode shows, in which the arm and the block go another way."""
    return Shown.of(1, key_views(*walk_along(RIGHT, episode=1)[1:]))


def elements(keys: tuple[KeyView, ...]) -> int:
    """Surface elements that were seen."""
    return sum(int((key.new & (key.empty.seen > 0)).sum()) for key in keys)


def usually_off(key: KeyView, scene: SyntheticScene) -> float:
    """Median relative error of the depth of what stands still and no key view before shows."""
    surface = scene.surface(key.camera, [0])
    still = torch.from_numpy(scene.instance_of_primitive[surface.primitive[0]] == 0)
    off = (key.empty.depth / torch.from_numpy(surface.depth[0]) - 1).abs()
    return float(off[(key.empty.seen > 0) & still & key.new].median())


def brought(shown: Shown, shift_m: float) -> Shown:
    """With poses that are all shifted."""
    poses = shown.camera.world_from_camera.clone()
    poses[:, 0, 3] += shift_m
    return replace(shown, camera=replace(shown.camera, world_from_camera=poses))


def test_what_the_episode_shows_itself_stays_as_it_is(here: Walked, keys: tuple[KeyView, ...], there: Shown) -> None:
    found = with_shown(keys, here[1], [there])
    assert len(found) > len(keys)
    assert elements(found) > 1.05 * elements(keys)
    for before, after in zip(keys, found, strict=False):
        own = before.empty.seen > 0
        assert torch.equal(after.empty.rgb[own], before.empty.rgb[own])
        assert torch.equal(after.empty.depth[own], before.empty.depth[own])
        assert torch.equal(after.empty.seen[own], before.empty.seen[own])


def test_surfaces_from_elsewhere_are_where_they_are_in_truth(
    here: Walked, keys: tuple[KeyView, ...], there: Shown
) -> None:
    found = with_shown(keys, here[1], [there])
    assert max(usually_off(key, here[0]) for key in found[len(keys) :]) < 0.01


def test_a_thing_that_stood_there_alone_is_left_out(here: Walked, keys: tuple[KeyView, ...], there: Shown) -> None:
    depth, rgb = there.depth.clone(), there.rgb.clone()
    depth[0, 30:44, 30:50] *= 0.7  # a card before the desk, red
    rgb[0, 30:44, 30:50] = torch.tensor([250, 0, 0], dtype=torch.uint8)
    found = with_shown(keys, here[1], [replace(there, depth=depth, rgb=rgb)])
    assert len(found) > len(keys)
    for key in found:
        red = (key.empty.rgb[..., 0] > 200) & (key.empty.rgb[..., 1:].amax(-1) < 40) & (key.empty.seen > 0)
        assert red.sum() < 5


def test_brightness_may_differ_by_a_gain(here: Walked, keys: tuple[KeyView, ...], there: Shown) -> None:
    darker = replace(there, rgb=(there.rgb.float() * 0.7).round().to(torch.uint8))
    bright, dark = (with_shown(keys, here[1], [other]) for other in (there, darker))
    assert len(bright) == len(dark)
    for one, other in zip(bright, dark, strict=True):
        both = (one.empty.seen > 0) & (other.empty.seen > 0)
        difference = (one.empty.rgb.int() - other.empty.rgb.int()).abs()[both]
        assert difference.float().mean() < 3  # grey levels
        assert both.sum() > 0.98 * (one.empty.seen > 0).sum()


def test_poses_that_are_a_little_beside_are_refined(here: Walked, keys: tuple[KeyView, ...], there: Shown) -> None:
    beside = brought(there, 0.01)
    assert elements(with_shown(keys, here[1], [beside], refine=False)) == elements(keys)
    whole = elements(with_shown(keys, here[1], [there]))
    assert elements(with_shown(keys, here[1], [beside])) == pytest.approx(whole, rel=0.02)


@pytest.mark.parametrize("arc", [LEFT, RIGHT])
def test_a_desk_that_is_laid_otherwise_is_refused(
    here: Walked, keys: tuple[KeyView, ...], arc: tuple[float, float]
) -> None:
    other = Shown.of(1, key_views(*walk_along(arc, seed=6, episode=1)[1:]))
    assert with_shown(keys, here[1], [other]) == keys


def test_a_frame_that_is_not_the_same_is_refused(here: Walked, keys: tuple[KeyView, ...], there: Shown) -> None:
    assert with_shown(keys, here[1], [brought(there, 0.08)]) == keys
    assert with_shown(keys, here[1], [brought(there, 20.0)]) == keys  # nothing is in both


def test_poses_of_another_world_or_of_none_are_not_shared(here: Walked, there: Shown) -> None:
    view = here[1]
    assert there.fits(view)
    for world in ("", "another desk"):
        assert not there.fits(replace(view, camera=replace(view.camera, world=world)))
        assert not replace(there, camera=replace(there.camera, world=world)).fits(view)
    nameless = replace(there, camera=replace(there.camera, world=""))
    assert not nameless.fits(replace(view, camera=replace(view.camera, world="")))
    stands = static_camera(view.camera.intrinsics[0], FRAMES, WIDTH, HEIGHT, view.camera.world_from_camera[0])
    assert not there.fits(replace(view, camera=replace(stands, world="desk")))


def test_what_is_kept_for_a_run_that_goes_on_is_read_back(there: Shown, tmp_path: Path) -> None:
    save_value(tmp_path / "kept.safetensors", {"front": [there]}, tmp_path)
    again: Shown = load_value(tmp_path / "kept.safetensors", tmp_path)["front"][0]
    assert (again.episode, again.camera.world) == (1, "desk")
    assert torch.equal(again.depth, there.depth)
    assert torch.equal(again.camera.world_from_camera, there.camera.world_from_camera)


@pytest.mark.parametrize("world", ["", "desk"])
def test_an_episode_is_looked_at_only_where_its_poses_can_be_compared(
    here: Walked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, world: str
) -> None:
    _, view, priors = here
    camera = view.camera
    content = Exchange(FRAMES, HEIGHT, WIDTH, w2c=camera.camera_from_world.numpy(), world=world)
    write_exchange(tmp_path / "poses.npz", content)
    settings = Recipe()
    settings.camera.poses = str(tmp_path / "poses.npz")
    assert settings.camera.known_before("front")
    asked = []

    def true_priors(seen: View, *_: object, **__: object) -> Priors:
        asked.append(seen)
        return replace(priors, camera=camera)

    monkeypatch.setattr(share_background, "estimate_priors", true_priors)
    assumed = replace(view, camera=static_camera(camera.intrinsics[0], FRAMES, WIDTH, HEIGHT))
    found = shown_by(assumed, settings, 1, "front")
    assert len(asked) == (1 if world else 0)
    assert (found is None) == (not world)
    for poses in ("auto", "fixed", "sfm"):
        settings.camera.poses = poses
        assert not settings.camera.known_before("front")


def reconstructed(walked: Walked, backgrounds: list[Shown], episode: int = 0) -> Reconstruction:
    """With true priors and few steps."""
    _, view, priors = walked

    def given(draft: Draft) -> None:
        draft.priors = priors

    settings = Recipe()
    settings.fit.steps, settings.priors.cache, settings.scene.moving_gaussians = 40, "off", 0
    settings.scene.short_lived, settings.scene.overlay = 0, False
    return reconstruct(view, settings, backgrounds=backgrounds, episode=episode, steps=with_steps({"priors": given}))


def test_more_of_a_view_is_covered_and_what_was_covered_is_as_good(here: Walked, there: Shown) -> None:
    scene = here[0]
    frames = [0, 4, 8, 11]
    camera = walking_camera(FRAMES, WIDTH, HEIGHT, (LEFT[0] + 14, LEFT[1] + 14)).select(frames)
    truth = scene.render(camera, frames)
    still = (truth.instances == 0).numpy()

    def seen(backgrounds: list[Shown]) -> list[Picture]:
        return [*new_pictures(reconstructed(here, backgrounds), camera, torch.tensor(frames))]

    alone, shared = seen([]), seen([there])
    uncovered = [np.stack([picture.unseen for picture in pictures]) for pictures in (alone, shared)]
    assert uncovered[1].mean() < 0.6 * uncovered[0].mean()

    def psnr_db(pictures: list[Picture], where: np.ndarray) -> float:
        rgb = np.concatenate([picture.rgb for picture in pictures])
        return masked_psnr_db(rgb, np.concatenate([*truth.rgb.numpy()]), np.concatenate([*where]))

    new = uncovered[0] & ~uncovered[1] & still
    assert new.mean() > 0.02
    assert psnr_db(shared, new) > 19
    assert psnr_db(shared, new) > 1 + psnr_db(alone, new)  # which fills it from around
    own = ~uncovered[0] & still
    assert psnr_db(shared, own) > psnr_db(alone, own) - 0.1


def test_an_episode_takes_nothing_of_itself(here: Walked, there: Shown) -> None:
    alone, itself = (reconstructed(here, backgrounds, episode=1) for backgrounds in ([], [there]))
    assert torch.equal(alone.windows[0].evidence.depth, itself.windows[0].evidence.depth)


def rough(shown: Shown, seed: int, by: float = 0.05) -> Shown:
    """With depth that is off as a network's is: by something smooth that is another in every video."""
    bias = torch.nn.functional.interpolate(
        by * torch.randn(1, 1, 5, 7, generator=torch.Generator().manual_seed(seed)), (HEIGHT, WIDTH), mode="bicubic"
    )[0, 0]
    return replace(shown, depth=shown.depth * bias.exp())


def test_depth_that_nobody_measured_is_brought_to_that_of_the_episode(
    here: Walked, keys: tuple[KeyView, ...], there: Shown
) -> None:
    off = rough(there, 1)
    assert with_shown(keys, here[1], [off]) == keys  # as if it had been measured
    found = with_shown(keys, here[1], [off], measured=False)
    assert elements(found) > 1.05 * elements(keys)
    assert max(usually_off(key, here[0]) for key in found[len(keys) :]) < 0.04


def test_another_desk_is_refused_by_such_depth_as_well(here: Walked, keys: tuple[KeyView, ...], there: Shown) -> None:
    for arc in (LEFT, RIGHT):
        other = Shown.of(1, key_views(*walk_along(arc, seed=6, episode=1)[1:]))
        assert with_shown(keys, here[1], [rough(other, 2)], measured=False) == keys
    assert with_shown(keys, here[1], [rough(brought(there, 0.08), 1)], measured=False) == keys
