"""The report: one file, nothing from outside, every text escaped, bounded."""

import dataclasses
import html.parser
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment import episode as episodes
from lerobot_msdyn.augment.report import build
from lerobot_msdyn.augment.report.drawing import cameras_from_above
from lerobot_msdyn.augment.report.page import ADVICE, LISTED, Origin, Pictures, ViewEntry, camera_lines, page, summary
from lerobot_msdyn.augment.report.pictures import data_url, film, heat_map, spread, strip
from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.reconstruction.account import Account, account_sentence
from lerobot_msdyn.reconstruction.result import FittedWindow
from lerobot_msdyn.scene.sources import MovingPixels
from lerobot_msdyn.views.gate import Scores

FRONT = "observation.images.front"
FAST = ("--fit.steps", "4", "--scene.moving_gaussians", "500", "--scene.moving_frames", "4", "--fit.max_width", "48")
NASTY = "<script>alert('x')</script>\"&"
SCORES = {
    "expected_db": 21.5,
    "held_out_db": 27.0,
    "moving_db": 21.0,
    "moving_with_overlay_db": 29.0,
    "by_motion": 0.25,
    "by_short_lived": 0.15,
    "by_overlay": 0.6,
    "held_out_ssim": 0.9,
    "unseen": 0.05,
    "angle_deg": 4.0,
    "track_px": 0.5,
    "flicker_ratio": 0.4,
    "sharpness_ratio": 0.6,
    "causes": {"video": 0.6, "geometry": 0.4},
    "frames": [{"frame": 3, "expected_db": 21.5, "unseen": 0.05, "angle_deg": 4.0, "sharpness_ratio": 0.6}],
    "heat": [[0, 50], [100, 0]],
}
WHAT_MOVES = {
    "pixels": 1000,
    "by_motion": 0.3,
    "by_short_lived": 0.1,
    "by_overlay": 0.58,
    "by_background": 0.02,
    "dynamic_db": 28.4,
    "dynamic_by_motion_db": 19.6,
    "held_out": True,
}
VOID = {"meta", "img", "br", "circle", "polygon", "polyline"}


class Outline(html.parser.HTMLParser):
    """Tags in order; complains where they are not closed as they were opened."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self._open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop() == tag

    def finished(self) -> "Outline":
        self.close()
        assert self._open == []
        return self


def outline(text: str) -> Outline:
    found = Outline()
    found.feed(text)
    return found.finished()


def entry(episode: int = 0, **changes: Any) -> ViewEntry:
    view = {"camera_from_source": np.eye(4).tolist(), "distance_m": 0.6, "what_moves": WHAT_MOVES, "scores": SCORES}
    plain = ViewEntry(episode, 0, FRONT, {"azimuth_deg": 3.0, "shift_x_m": 0.01}, view, [], dropped=False)
    return dataclasses.replace(plain, **changes)


def test_every_text_is_escaped() -> None:
    pictures = Pictures("data:image/jpeg;base64,", "data:image/jpeg;base64,", 3, 2.0, None, "", "")
    entries = [
        entry(camera=NASTY, amounts={NASTY: 1.0}, rejected=[NASTY], pictures=pictures),
        entry(camera=NASTY, rejected=[NASTY], dropped=True),
    ]
    text = page(NASTY, {NASTY: NASTY}, entries, [NASTY])
    assert "<script" not in text
    assert "alert(&#x27;x&#x27;)" in text
    assert "script" not in outline(text).tags


def test_a_dropped_view_says_why_and_a_redrawn_one_too() -> None:
    text = page("ds", {}, [entry(rejected=["too dark"], dropped=True)], ["episode 3: no video"])
    assert "Why it was dropped" in text
    assert "dropped: too dark" in text
    assert "episode 3: no video" in text
    pictures = Pictures("", "", 1, 1.0, None, "", "")
    assert "Sampled again, since" in page("ds", {}, [entry(rejected=["too dark"], pictures=pictures)], [])


def scored(db: float, cause: str) -> dict[str, Any]:
    """A view of some expected quality, whose error is of one cause."""
    scores = SCORES | {"expected_db": db, "causes": {name: float(name == cause) for name in ADVICE}}
    return {"view": entry().view | {"scores": scores}}


@pytest.mark.parametrize(("angle", "verdict"), [(4.0, "good"), (8.0, "doubtful")])
def test_far_turns_on_assumed_depth_are_doubtful_whatever_their_score(angle: float, verdict: str) -> None:
    view = entry().view | {"scores": SCORES | {"expected_db": 25.0, "angle_deg": angle}}
    assert entry(view=view).verdict == "good"
    assumed = entry(view=view, assumed=True)
    assert assumed.verdict == verdict
    assert ("depth is a guess" in summary([assumed])) == (verdict == "doubtful")


def test_it_opens_with_what_is_good_and_what_would_make_the_rest_better() -> None:
    assert summary([]) == "No new views."
    assert summary([entry(**scored(25, "depth")), entry(**scored(20, "video"))]) == "2 of 2 views good."
    some = [
        entry(**scored(25, "video")),
        entry(**scored(17, "depth")),
        entry(**scored(12, "depth"), rejected=["dim"], dropped=True),
    ]
    assert summary(some).startswith("1 of 3 views good, 1 doubtful, 1 dropped: depth is a guess; lower --perturbation")
    text = page(
        "ds", {}, [dataclasses.replace(each, pictures=Pictures("", "", 1, 1.0, None, "", "")) for each in some], []
    )
    assert '<article class="good">' in text
    assert '<article class="doubtful">' in text
    assert "doubtful: 17.0 dB expected" in text
    assert text.index("1 of 3 views good") < text.index("<h2>")


def test_the_worst_come_first_and_assumed_depth_is_said_above_all() -> None:
    pictures = Pictures("", "", 1, 1.0, None, "", "")
    good, bad = entry(0, **scored(25, "depth"), pictures=pictures), entry(1, **scored(15, "depth"), pictures=pictures)
    dropped = entry(2, **scored(10, "depth"), rejected=["dim"], dropped=True, pair="data:image/jpeg;base64,")
    origin = Origin({"depth": NASTY}, True, NASTY, {NASTY: "data:image/jpeg;base64,"})
    text = page("ds", {}, [good, bad, dropped], [], origin)
    places = [text.index(f"<h3>Episode {number},") for number in (2, 1, 0)]
    assert places == sorted(places)
    assert text.index("Depth was assumed here") < text.index("<h2>")
    assert "Depth was assumed" not in page("ds", {}, [good], [])
    assert "A frame of it: recorded left, new right" in text
    assert "<script" not in text
    outline(text)


def test_views_that_were_not_judged_are_shown_as_such() -> None:
    view = {"camera_from_source": np.eye(4).tolist(), "distance_m": 0.6, "what_moves": WHAT_MOVES}
    text = page("ds", {}, [entry(view=view, pictures=Pictures("", "", 1, 1.0, None, "", ""))], [])
    assert "not judged" in text
    outline(text)


def test_it_says_what_renders_what_moves() -> None:
    """Per camera, every episode once, however many variants it has; and a row per view."""
    other = WHAT_MOVES | {"by_motion": 0.9, "by_short_lived": 0.0, "by_overlay": 0.1, "by_background": 0.0}
    second = entry(1, view=entry().view | {"what_moves": other})
    text = page("ds", {}, [entry(0), entry(0), second], [])
    assert f"{FRONT}: of the pixels that show something moving, 60 % are rendered by motion, 5 % are recorded" in text
    assert "PSNR is 28.4 dB, and 19.6 dB by motion alone" in text
    assert text.count("<td>30%</td><td>10%</td><td>58%</td><td>28.4 dB</td><td>19.6 dB</td>") == 2
    nothing: dict[str, Any] = WHAT_MOVES | {"pixels": 0} | dict.fromkeys(MovingPixels().shares, 0.0)
    nothing |= {"dynamic_db": None, "dynamic_by_motion_db": None}
    still = page("ds", {}, [entry(0, view=entry().view | {"what_moves": nothing})], [])
    assert "nothing moves in the frames that were checked" in still
    outline(still)


def test_it_says_where_cameras_were_moved() -> None:
    def seen(episode: int, **camera: Any) -> ViewEntry:
        found = {"drift_px": 0.2, "moved": [], "stands": True, "displaced_px": 0.1} | camera
        return entry(episode, view=entry().view | {"camera": found})

    assert "They keep still." in page("ds", {}, [seen(0), seen(1), seen(2, displaced_px=None)], [])
    entries = [
        seen(0, moved=[{"frame": 12, "px": 13.4}]),
        seen(1, drift_px=9.5),
        seen(2, displaced_px=30.0),
        seen(3, displaced_px=30.1),
        seen(4, stands=False, drift_px=90.0),
        seen(5, stands=False, path_m=0.314),
    ]
    assert camera_lines([*entries, *entries]) == [
        f"{FRONT}, episode 0: moved by 13.4 px before frame 12",
        f"{FRONT}, episode 1: drifts by 9.5 px",
        f"{FRONT}, episode 2: begins 30.0 px from where episode 0 does",
        f"{FRONT}, episode 4: it moves, by 90.0 px",
        f"{FRONT}, episode 5: it moves along 0.31 m, by its poses",
    ]
    text = page("ds", {}, entries, [])
    assert "episode 0: moved by 13.4 px" in text
    assert "<td>9.5</td>" in text
    outline(text)


def test_the_page_is_bounded() -> None:
    many = [entry(i) for i in range(LISTED + 500)]
    text = page("ds", {}, many, [])
    assert "500 more are in meta/msdyn/episodes.parquet" in text
    assert len(text) < 1_000_000
    scored = [entry(i, view={"scores": {"expected_db": 100.0 - i}}) for i in range(100)]
    chosen = build._pictured(scored)
    assert len(chosen) == build.PICTURED
    assert {99, 98, 0, 1} <= chosen


def test_cameras_from_above_stay_inside_the_picture() -> None:
    moved = np.eye(4)
    moved[:3, 3] = [0.3, 0.1, -0.2]
    text = cameras_from_above([moved.tolist(), np.eye(4).tolist()], 0.5)
    points = re.findall(r"(-?[\d.]+),(-?[\d.]+)", text)
    assert len(points) == 3 * (2 + 3)
    assert all(0 <= float(value) <= 260 for point in points for value in point)


def test_pictures() -> None:
    before = [np.full((48, 64, 3), value, np.uint8) for value in (10, 60, 110)]
    after = [np.full((48, 64, 3), value, np.uint8) for value in (20, 70, 120)]
    assert strip(before, after).shape == (2 * 168 + 4, 3 * 224 + 2 * 4, 3)
    assert film(before, after).shape == (180, 3 * 480, 3)
    found = heat_map(after[0], [[0, 100]])
    assert found[0, -1, 0] > found[0, 0, 0] + 50
    assert found[0, 0, 0] == found[0, 0, 1]
    assert spread(100, 3).tolist() == [0, 50, 99]
    assert spread(2, 5).tolist() == [0, 1]
    assert data_url(before[0]).startswith("data:image/jpeg;base64,/9j/")


@pytest.fixture(scope="module")
def reported(desk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("reported") / "new"
    arguments = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(out), "--episodes", "[0]"]
    assert augment.run([*arguments, "--cameras", "[front]", "--variants", "2", *FAST]) == 0
    return out


def test_a_run_leaves_a_report_that_needs_nothing_else(reported: Path) -> None:
    text = (reported / "report.html").read_text()
    found = outline(text)
    assert found.tags.count("article") == 2
    assert all(link.startswith("data:image/") for link in found.links)
    assert not re.search(r"(https?:)?//", re.sub(r"data:image/jpeg;base64,[A-Za-z0-9+/=]+", "", text))
    assert len(text) < 2_000_000


def test_report_and_record_agree_on_what_renders_what_moves(reported: Path) -> None:
    rows = pq.read_table(reported / "meta" / "msdyn" / "episodes.parquet").to_pylist()
    views = [json.loads(row["gate"])["views"][FRONT] for row in rows if row["variant"] >= 0]
    assert len(views) == 2
    for view in views:  # of one reconstruction
        assert view["what_moves"] == views[0]["what_moves"]
        assert view["what_moves"]["pixels"] > 0
        assert 0 <= view["scores"]["by_overlay"] <= 1
        assert view["scores"]["moving_db"] == pytest.approx(view["what_moves"]["dynamic_by_motion_db"], abs=0.01)
    sentence = account_sentence(Account.from_entry(views[0]["what_moves"]))
    assert f"{FRONT}: {sentence}" in (reported / "report.html").read_text()


def test_what_the_gate_rejects_is_drawn_again_and_then_dropped(
    desk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[CameraTrack] = []
    judge = episodes.judge

    def counted(windows: Sequence[FittedWindow], camera: CameraTrack) -> Scores:
        drawn.append(camera)
        scores = judge(windows, camera)
        return dataclasses.replace(scores, expected_db=1.0) if len(drawn) in (1, 2, 3, 4) else scores

    monkeypatch.setattr(episodes, "judge", counted)
    flashes = iter(("", "frame 2 flashes"))  # of variants 1 and 2
    monkeypatch.setattr(episodes, "too_large", lambda *_: next(flashes))
    arguments = ["--repo", "local/desk", "--root", str(desk), "--new_root", str(tmp_path / "new"), "--episodes", "[0]"]
    settings = ["--cameras", "[front]", "--variants", "3", "--gate.redraws", "2", *FAST]
    assert augment.run([*arguments, *settings]) == 1
    said = capsys.readouterr().out
    assert "dropped: episode 0 variant 0: " in said
    assert f"dropped: episode 0 variant 2: {FRONT}: frame 2 flashes" in said
    assert "1 new ones" in said
    assert f"{FRONT}: what moves: " in said
    assert len(drawn) == 3 + 2 + 1
    poses = {tuple(camera.world_from_camera[0].flatten().tolist()) for camera in drawn}
    assert len(poses) == len(drawn)
    text = (tmp_path / "new" / "report.html").read_text()
    assert "Why it was dropped" in text
    assert "Sampled again, since" in text
