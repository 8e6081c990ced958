"""What moves, from pictures alone."""

import numpy as np
import torch
from torch import Tensor

from lerobot_msdyn.priors.masks.moving import moving_instances, temporal_median


def overlap(found: Tensor, truth: Tensor) -> float:
    """Intersection over union."""
    return float((found & truth).sum() / (found | truth).sum())


def test_the_median_forgets_what_passes(sliding) -> None:
    median, noise = temporal_median(sliding.rgb)
    difference = np.abs(median.numpy().astype(float) - sliding.empty).mean(-1)
    seldom_covered = sliding.mask.float().mean(0).numpy() < 0.3
    assert np.quantile(difference[seldom_covered], 0.99) < 4
    assert noise.min() >= 1
    assert noise.shape == (72, 96)


def test_a_block_is_found_also_while_it_rests(sliding) -> None:
    """It rests for 8 frames at one place and for 10 at another, which both are partly in the median."""
    median, noise = temporal_median(sliding.rgb)
    instances = moving_instances(sliding.rgb, median, noise)
    assert instances.max() == 1
    for frame in (0, 4, 12, 18, 25, 29):
        assert overlap(instances[frame] > 0, sliding.mask[frame]) > 0.75, frame


def test_two_things_keep_their_numbers(sliding) -> None:
    """A second, smaller block slides the other way below the first."""
    rgb = sliding.rgb.clone()
    for t in range(30):
        x = 60 - t
        rgb[t, 52:64, x : x + 12] = rgb[0, 28:40, 14:26].flip(-1)
    median, noise = temporal_median(rgb)
    instances = moving_instances(rgb, median, noise)
    for t in (3, 14, 26):
        assert instances[t, 34, int(sliding.corner[t, 0]) + 12] == 1
        assert instances[t, 58, 66 - t] == 2


def test_a_still_video_has_no_instances(sliding) -> None:
    rgb = sliding.rgb[:1].expand(8, -1, -1, -1).contiguous()
    median, noise = temporal_median(rgb)
    assert not moving_instances(rgb, median, noise).any()


def test_another_episode_shows_what_this_one_hides(sliding) -> None:
    """The block never leaves its place by more than its own width; in another episode it is not there."""
    rgb = sliding.rgb[:8]
    median, _ = temporal_median(rgb)
    bare = torch.from_numpy(sliding.empty.round().astype(np.uint8)).expand(12, -1, -1, -1)
    better, noise = temporal_median(rgb, bare)
    inside = sliding.mask[0]
    assert np.abs(better.numpy().astype(float) - sliding.empty).mean(-1)[inside].mean() < 4
    assert np.abs(median.numpy().astype(float) - sliding.empty).mean(-1)[inside].mean() > 20
    instances = moving_instances(rgb, better, noise, bare)
    assert overlap(instances[4] > 0, sliding.mask[4]) > 0.75
