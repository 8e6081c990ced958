"""What a robot holds before its links is told by its colours."""

import numpy as np

from lerobot_msdyn.priors.masks.before_links import shown_before

FRAMES, HEIGHT, WIDTH = 6, 120, 180
HAND, JAW = (slice(0, 45), slice(30, 120)), (slice(15, 75), slice(60, 90))
HELD = (slice(54, 84), slice(72, 108))  # before the jaw's end
GREY, RED, BLACK = (130, 130, 130), (190, 60, 50), (15, 15, 15)


def video(held: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pictures, the pixels of links by the joints, and the masks of things; hand and jaw are grey and black."""
    rgb = np.full((FRAMES, HEIGHT, WIDTH, 3), (60, 70, 40), np.uint8)
    links, others = np.zeros((FRAMES, HEIGHT, WIDTH), bool), np.zeros((FRAMES, HEIGHT, WIDTH), np.uint8)
    rgb[:, *HAND], rgb[:, 2:14, 30:60], links[:, *HAND] = GREY, BLACK, True
    rgb[:, *JAW], links[:, *JAW] = GREY, True
    rgb[:, *HELD], others[:, *HELD] = held, 3
    noise = np.random.default_rng(0).normal(0, 4, rgb.shape)
    return (rgb + noise).clip(0, 255).astype(np.uint8), links, np.where(links, 0, others)


def test_what_hides_a_link_is_told_by_its_colours() -> None:
    rgb, links, others = video(RED)
    found = shown_before(rgb, links, others)
    assert (found[:, *HELD] == 3).mean() > 0.97
    assert not found[:, 15:51, 60:90].any()


def test_a_thing_of_the_links_colour_keeps_what_it_has() -> None:
    rgb, links, others = video(GREY)
    assert (shown_before(rgb, links, others) == others).all()


def test_what_is_not_joined_to_the_thing_stays_the_links() -> None:
    rgb, links, others = video(RED)
    rgb[:, 30:36, 66:78] = RED  # a red spot of the jaw's own
    found = shown_before(rgb, links, others)
    assert not found[:, 15:45, 60:90].any()


def test_a_thing_that_the_links_hide_in_between_is_found_from_frame_to_frame() -> None:
    rgb, links, others = video(RED)
    links[2:4, 42:90, 54:120] = True
    others[links] = 0
    found = shown_before(rgb, links, others)
    assert (found[2:4, *HELD] == 3).mean() > 0.9


def test_nothing_there_changes_nothing() -> None:
    rgb, links, others = video(RED)
    assert not shown_before(rgb, links, np.zeros_like(others)).any()
    assert (shown_before(rgb, np.zeros_like(links), others) == others).all()
