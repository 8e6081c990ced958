"""Exchange files: what is written is read, and what cannot be used is named in one line."""

import json
from pathlib import Path

import numpy as np
import pytest

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.priors.exchange import Exchange, read_exchange, write_exchange
from lerobot_msdyn.priors.files import exchange_path

T, H, W, N = 5, 24, 32, 7
FRONT = "observation.images.front"


def content() -> dict[str, np.ndarray]:
    """Arrays of every kind, all of them good."""
    generator = np.random.default_rng(0)
    return {
        "frames": np.array(T),
        "size": np.array([H, W]),
        "episode": np.array(3),
        "camera": np.array(FRONT),
        "masks": generator.integers(0, 3, (T, H, W)).astype(np.uint8),
        "depth": generator.uniform(1, 2, (T, H, W)).astype(np.float32),
        "depth_kind": np.array("metric"),
        "depth_conf": np.ones((T, H, W), np.float32),
        "tracks": generator.uniform(0, 20, (N, T, 2)).astype(np.float32),
        "vis": np.ones((N, T), bool),
        "conf": np.ones((N, T), np.float32),
        "query_t": np.zeros(N, np.int64),
        "K": np.tile(np.array([[30, 0, 16], [0, 30, 12], [0, 0, 1]], np.float32), (T, 1, 1)),
        "w2c": np.tile(np.eye(4, dtype=np.float32), (T, 1, 1)),
        "world": np.array("cell"),
        "provenance": np.array(json.dumps({"depth": {"model": "some/model", "licence": "MIT"}})),
    }


def save(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    np.savez(path, **arrays)  # type: ignore[arg-type]  # no array is called allow_pickle
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    arrays = content()
    names = set(vars(Exchange(T, H, W))) - {
        "frames",
        "height",
        "width",
        "provenance",
        "depth_kind",
        "episode",
        "camera",
        "world",
    }
    written = Exchange(
        T,
        H,
        W,
        3,
        FRONT,
        depth_kind="scale",
        world="cell",
        provenance={"a": 1},
        **{name: arrays[name] for name in names},
    )
    write_exchange(tmp_path / "new" / "x.npz", written)
    read = read_exchange(tmp_path / "new" / "x.npz", T, H, W, 3, FRONT)
    assert (read.depth_kind, read.world, read.provenance) == ("scale", "cell", {"a": 1})
    for name in names:
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))


def test_another_size_is_brought_to_the_video_s(tmp_path: Path) -> None:
    arrays = content()
    read = read_exchange(save(tmp_path / "x.npz", arrays), T, 2 * H, 2 * W)
    assert read.masks is not None
    assert read.tracks is not None
    assert read.K is not None
    np.testing.assert_array_equal(read.masks, arrays["masks"].repeat(2, axis=1).repeat(2, axis=2))
    np.testing.assert_allclose(read.tracks, 2 * arrays["tracks"])
    np.testing.assert_allclose(read.K[0], [[60, 0, 32], [0, 60, 24], [0, 0, 1]])


def test_a_single_k_holds_for_all_frames_and_unseen_points_may_be_nan(tmp_path: Path) -> None:
    arrays = content()
    arrays["K"] = arrays["K"][0]
    arrays["tracks"][2, 3], arrays["vis"][2, 3] = np.nan, False
    read = read_exchange(save(tmp_path / "x.npz", arrays), T, H, W)
    assert read.K is not None
    assert read.tracks is not None
    assert read.K.shape == (T, 3, 3)
    assert np.isfinite(read.tracks).all()


BAD: dict[str, tuple[dict[str, np.ndarray], str]] = {
    "another episode": ({"episode": np.array(4)}, "is of episode 4, not 3: it belongs to another video"),
    "another camera": ({"camera": np.array("observation.images.side")}, "is of camera .*side, not .*front"),
    "another length": ({"frames": np.array(9)}, "is of 9 frames, the episode has 5: of another episode"),
    "another aspect ratio": ({"size": np.array([30, 30])}, "is of 30x30 pixels, the video of 32x24"),
    "masks of another shape": (
        {"masks": np.zeros((T, H - 1, W), np.uint8)},
        r"masks has shape \[5, 23, 32\]; expected",
    ),
    "masks of too few frames": ({"masks": np.zeros((4, H, W), np.uint8)}, r"masks has shape \[4, 24, 32\]"),
    "a single mask": ({"masks": np.zeros((H, W), np.uint8)}, r"masks has shape \[24, 32\]; expected \[5, 24, 32\]"),
    "masks of logits": ({"masks": np.zeros((T, H, W), np.float32)}, "masks are float32; expected instance ids"),
    "negative ids": ({"masks": np.full((T, H, W), -1)}, "expected instance ids, whole numbers 0 to 255"),
    "NaN tracks": ({"tracks": np.full((N, T, 2), np.nan)}, "35 visible positions of tracks are NaN"),
    "tracks of another shape": ({"tracks": np.zeros((N, T))}, r"tracks has shape \[7, 5\]; expected \[n, 5, 2\]"),
    "visibility of another shape": ({"vis": np.ones((N, 4), bool)}, r"vis has shape \[7, 4\]; expected \[7, 5\]"),
    "all-zero depth": ({"depth": np.zeros((T, H, W), np.float32)}, "depth holds no measurement"),
    "an unknown kind of depth": ({"depth_kind": np.array("feet")}, "depth_kind is 'feet'; expected one of metric"),
    "a NaN pose": ({"w2c": np.full((T, 4, 4), np.nan)}, "w2c has NaN"),
    "text for numbers": ({"conf": np.full((N, T), "x")}, "conf is of type <U1; expected numbers"),
    "provenance that is not JSON": ({"provenance": np.array("{")}, "provenance is not JSON"),
}


@pytest.mark.parametrize("case", BAD, ids=list(BAD))
def test_bad_content_is_named_in_one_line(tmp_path: Path, case: str) -> None:
    changes, message = BAD[case]
    path = save(tmp_path / "bad.npz", content() | changes)
    with pytest.raises(PriorError, match=message) as caught:
        read_exchange(path, T, H, W, 3, FRONT)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_tracks_need_visibility_and_a_size(tmp_path: Path) -> None:
    arrays = content()
    tracks = {name: arrays[name] for name in ("tracks", "vis")}
    with pytest.raises(PriorError, match=r"of which size its images are; add size = \[height, width\]"):
        read_exchange(save(tmp_path / "a.npz", tracks), T, H, W)
    with pytest.raises(PriorError, match="tracks without vis"):
        read_exchange(save(tmp_path / "b.npz", {"tracks": arrays["tracks"], "size": arrays["size"]}), T, H, W)


@pytest.mark.parametrize("damage", ["absent", "text", "cut", "pickled"])
def test_an_unreadable_file_is_named(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "bad.npz"
    if damage == "text":
        path.write_text("no zip")
    elif damage == "cut":
        save(path, content())
        path.write_bytes(path.read_bytes()[:500])
    elif damage == "pickled":
        np.savez(path, depth=np.array([object()]))
    with pytest.raises(PriorError, match=r"bad\.npz: not a readable npz file of plain arrays"):
        read_exchange(path, T, H, W)


def test_braces_stand_for_episode_and_camera() -> None:
    assert exchange_path("x/{episode:06d}/{camera}.npz", 7, FRONT) == Path(f"x/000007/{FRONT}.npz")
    with pytest.raises(PriorError, match=r"only \{episode\} and \{camera\} are known"):
        exchange_path("x/{task}.npz", 7, FRONT)
