"""Features of motion, and k-means."""

import torch

from lerobot_msdyn.motion.from_tracks.clusters import (
    direction_features,
    displacement_features,
    filled,
    k_means,
    spread_nodes,
)


def test_gaps_are_bridged_inside_and_held_outside() -> None:
    series = torch.tensor([9.0, 1.0, 9.0, 9.0, 4.0, 9.0])[None, :, None].repeat(1, 1, 3)
    valid = torch.tensor([[False, True, False, False, True, False]])
    torch.testing.assert_close(filled(series, valid)[0, :, 0], torch.tensor([1.0, 1.0, 2.0, 3.0, 4.0, 4.0]))


def test_what_rests_has_no_direction() -> None:
    points = torch.randn(10, 3, generator=torch.Generator().manual_seed(0))
    resting = points[:, None] + 1e-3 * torch.randn(10, 30, 3, generator=torch.Generator().manual_seed(1))
    features = direction_features(points, resting, noise=1e-3)
    assert features[:, :-3].abs().max() < 0.2


def test_opposite_motions_are_told_apart_but_not_their_size_by_direction_alone() -> None:
    points = torch.zeros(3, 3)
    path = torch.linspace(0, 1, 30)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    positions = torch.stack((path, 2 * path, -path))
    direction = direction_features(points, positions, noise=1e-6)
    torch.testing.assert_close(direction[0], direction[1], atol=1e-3, rtol=0)
    assert (direction[0] - direction[2]).norm() > 0.9
    vectors = displacement_features(points, positions)
    assert (vectors[0] - vectors[1]).norm() > 0.1


def test_clusters_are_found_and_small_ones_given_up() -> None:
    generator = torch.Generator().manual_seed(0)
    centres = torch.tensor([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]])
    points = torch.cat(
        [c + 0.1 * torch.randn(n, 2, generator=generator) for c, n in zip(centres, (20, 20, 4), strict=True)]
    )
    label = k_means(points, 3, least=2)
    assert [len(label[a:b].unique()) for a, b in ((0, 20), (20, 40), (40, 44))] == [1, 1, 1]
    assert label.unique().tolist() == [0, 1, 2]
    assert k_means(points, 3, least=8).unique().tolist() == [0, 1]
    assert torch.equal(label, k_means(points, 3, least=2))
    assert k_means(points[:3], 10, least=5).tolist() == [0, 0, 0]
    assert k_means(points[:0], 3, least=1).shape == (0,)


def test_nodes_are_spread() -> None:
    points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    label = spread_nodes(points, 3)
    assert label[0] == label[1]
    assert label.unique().tolist() == [0, 1, 2]
