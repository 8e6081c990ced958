"""The dataset card: what it takes over from the source's."""

import os
from pathlib import Path

import pytest

from lerobot_msdyn.dataset.card import CARD, licence_of


@pytest.mark.parametrize(
    ("text", "licence"),
    [
        ("---\nlicense: mit\n---\nA desk.\n", "mit"),
        ("---\nlicense: [mit]\n---\n", None),
        ("---\nlicense: mit\n", None),
        ("---\n- mit\n---\n", None),
        ("A desk.\n", None),
        ("---\n" + "[" * 100_000 + "\n---\n", None),
        ("---\nlicense: mit\n---\n" + " " * (1 << 20), None),
    ],
)
def test_the_licence_of_a_card(text: str, licence: str | None, tmp_path: Path) -> None:
    (tmp_path / CARD).write_text(text)
    assert licence_of(tmp_path) == licence


def test_a_card_that_is_no_file_of_the_dataset(tmp_path: Path) -> None:
    assert licence_of(tmp_path) is None
    root = tmp_path / "ds"
    root.mkdir()
    os.mkfifo(root / CARD)
    assert licence_of(root) is None
    (root / CARD).unlink()
    (tmp_path / CARD).write_text("---\nlicense: mit\n---\n")
    (root / CARD).symlink_to(tmp_path / CARD)
    assert licence_of(root) is None
