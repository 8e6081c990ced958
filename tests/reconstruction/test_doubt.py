"""How far bases are to be learned, by the tracks that they miss."""

from dataclasses import replace

import torch
from motion_levels import of_bases
from moving_cards import FRAMES, moving_cards, targets_of

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.observations import PointTracks
from lerobot_msdyn.core.sampling import REFERENCE_WIDTH
from lerobot_msdyn.priors import Priors
from lerobot_msdyn.reconstruction.doubt import doubts, track_errors_px
from lerobot_msdyn.scene.dynamic import DynamicScene


def case(shift_m: float) -> tuple[DynamicScene, CameraTrack, Priors]:
    """Tracks of both cards, from the second of which a scene goes away by `shift_m` a frame."""
    truth = moving_cards(part_alone=True)
    targets = targets_of(truth)
    plain = replace(targets.priors, depth=torch.full_like(targets.priors.depth, 1.01))
    (level,) = of_bases(truth.levels)
    off = level.displacements.clone()
    off[1, :, 0] += shift_m * torch.arange(FRAMES)
    scene = replace(truth, levels=(replace(level, displacements=off),))
    return scene, targets.view.camera, plain


def test_a_right_basis_is_left_alone_and_a_wrong_one_is_learned() -> None:
    scene, camera, priors = case(0.05)
    (share,) = doubts(scene, camera, priors, sure_px=4.0)
    assert share[0] < 0.2
    assert share[1] > 0.8


def test_errors_are_in_pixels_of_pictures_320_wide() -> None:
    scene, camera, priors = case(0.05)
    gaussian, error = track_errors_px(scene, camera, priors)
    second = error[scene.indices[0][gaussian, 0] == 1]
    focal = float(camera.intrinsics[0, 0, 0]) * REFERENCE_WIDTH / camera.width
    per_frame = 0.05 * focal / 1.01
    assert per_frame * 0.8 < float(second.median()) < per_frame * 2.2  # from one to two frames away, in the middle


def test_without_the_setting_all_are_learned_and_without_tracks_none() -> None:
    scene, camera, priors = case(0.0)
    assert doubts(scene, camera, priors, sure_px=0.0)[0].tolist() == [1.0, 1.0]
    nothing = PointTracks(
        priors.tracks.xy[:0], priors.tracks.visible[:0], priors.tracks.confidence[:0], priors.tracks.instance[:0]
    )
    assert doubts(scene, camera, replace(priors, tracks=nothing), sure_px=1.0)[0].tolist() == [0.0, 0.0]
