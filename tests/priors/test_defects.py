"""Frames that do not show what was going on, in clips made for it."""

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors.defects import Defects, find_defects, repaired
from lerobot_msdyn.synthetic import make_scene

FRAMES = 24


@pytest.fixture(scope="module")
def camera() -> CameraTrack:
    return make_scene("push", 0, FRAMES, 96, 72).camera


@pytest.fixture(params=[0.0, 2.0], ids=["clean", "noisy"])
def clip(request: pytest.FixtureRequest) -> UInt8[Tensor, "t h w 3"]:
    """A textured room in which an arm swings."""
    rng = np.random.default_rng(0)
    room = cv2.resize(rng.integers(40, 200, (9, 12, 3)).astype(np.uint8), (96, 72), interpolation=cv2.INTER_CUBIC)
    frames = []
    for t in range(FRAMES):
        frame = room.copy()
        cv2.circle(frame, (20 + 2 * t, 36), 9, (230, 60, 30), -1)
        noisy = frame + rng.normal(0, request.param, frame.shape)
        frames.append(noisy.round().clip(0, 255).astype(np.uint8))
    return torch.from_numpy(np.stack(frames))


@pytest.fixture
def state() -> Float[Tensor, "t s"]:
    return torch.linspace(0, 1, FRAMES)[:, None] * torch.tensor([1.0, -2.0, 0.0])


def test_a_good_clip_has_none(clip: Tensor, state: Tensor) -> None:
    assert find_defects(clip, state) == Defects(FRAMES)
    assert find_defects(clip, None).lines() == []
    for frames in (1, 2, 3):
        assert find_defects(clip[:frames], state[:frames]) == Defects(frames)


def test_good_videos_of_scenes_have_none() -> None:
    for name in ("push", "lid", "sheet"):
        scene = make_scene(name, 0, FRAMES, 96, 72)
        rgb = scene.render(scene.camera).rgb
        assert find_defects(rgb, torch.linspace(0, 1, FRAMES)[:, None]).unusable == ()


@pytest.mark.parametrize("level", [0, 128, 255])
def test_blank_frames(clip: Tensor, state: Tensor, level: int) -> None:
    clip = clip.clone()
    clip[5:8] = level
    clip[20] = level
    found = find_defects(clip, state)
    assert found == Defects(FRAMES, blank=(5, 6, 7, 20))
    assert found.lines() == ["blank: frames 5 to 7, 20 (not fitted; new views show the nearest other frame)"]
    clip[:] = level
    assert find_defects(clip, state).unusable == tuple(range(FRAMES))


def test_a_video_that_turns_blank(clip: Tensor, state: Tensor) -> None:
    clip = clip.clone()
    clip[15:] = torch.tensor([90, 120, 100], dtype=torch.uint8)
    assert find_defects(clip, state).blank == tuple(range(15, FRAMES))


def test_frozen_pictures(clip: Tensor, state: Tensor) -> None:
    clip = clip.clone()
    clip[10:15] = clip[9]
    found = find_defects(clip, state)
    assert found == Defects(FRAMES, frozen=((10, 14),))
    assert found.lines() == ["frozen while the state moves: frames 10 to 14 (used as they are)"]
    still = state.clone()
    still[9:15] = still[9]
    assert find_defects(clip, still).frozen == ()
    assert find_defects(clip, None).frozen == ()


def test_a_camera_that_is_slower_than_the_rows_is_not_frozen(clip: Tensor, state: Tensor) -> None:
    assert find_defects(clip[torch.arange(FRAMES) // 2 * 2], state).frozen == ()


def test_a_first_frame_of_the_episode_before(clip: Tensor, state: Tensor) -> None:
    last = clip[-1:]
    assert not find_defects(clip, state, last).stray_start
    assert not find_defects(clip, state, clip[:1]).stray_start
    stray = clip.clone()
    stray[0] = last
    assert find_defects(stray, state, last) == Defects(FRAMES, stray_start=True)
    assert not find_defects(stray, state, clip[8:9]).stray_start
    assert not find_defects(stray, state).stray_start


@pytest.mark.parametrize("factor", [0.7, 1.25])
def test_a_step_of_the_exposure(clip: Tensor, state: Tensor, factor: float) -> None:
    clip = clip.clone()
    clip[12:] = (clip[12:].float() * factor).clamp(0, 255).to(torch.uint8)
    found = find_defects(clip, state)
    assert (found.blank, found.frozen, found.stray_start) == ((), (), False)
    ((frame, gain),) = found.exposure_steps
    assert frame == 12
    assert gain == pytest.approx(factor, rel=0.05)


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.3])
def test_a_first_frame_of_another_exposure_is_not_of_the_episode_before(
    clip: Tensor, state: Tensor, factor: float
) -> None:
    stepped = clip.clone()
    stepped[1:] = (clip[1:].float() * factor).clamp(0, 255).byte()
    found = find_defects(stepped, state, clip[:1])
    assert not found.stray_start
    assert [frame for frame, _ in found.exposure_steps] == [1]
    before = (clip[-1:].float() * factor).clamp(0, 255).byte()
    stepped[0] = clip[-1]
    assert find_defects(stepped, state, before).stray_start, "another moment, whatever its exposure"


def test_slow_changes_of_brightness_are_no_step(clip: Tensor, state: Tensor) -> None:
    fading = (clip.float() * torch.linspace(1, 0.6, FRAMES)[:, None, None, None]).to(torch.uint8)
    assert find_defects(fading, state).exposure_steps == ()


def test_neighbours_stand_in(clip: Tensor, camera: CameraTrack) -> None:
    depth = torch.arange(FRAMES).float()[:, None, None].expand(FRAMES, 72, 96)
    view = View(clip, camera, depth)
    assert repaired(view, Defects(FRAMES)) is view
    whole = repaired(view, Defects(FRAMES, blank=(5, 6, 7, FRAMES - 1), stray_start=True))
    assert whole.depth is not None
    taken = [1, 1, 2, 3, 4, 4, 4, 8, 8, *range(9, FRAMES - 1), FRAMES - 2]
    assert whole.depth[:, 0, 0].tolist() == taken
    assert torch.equal(whole.rgb, clip[taken])
    assert torch.equal(whole.camera.world_from_camera, camera.world_from_camera[taken])
