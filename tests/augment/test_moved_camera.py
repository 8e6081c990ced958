"""Episodes whose camera is not where it was: cut, steadied or dropped, and the record and the report say so."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from augment_command import FAST, FRONT, run
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from panned import HEIGHT, WIDTH, along, panned

from lerobot_msdyn.dataset.provenance import TABLE

pytestmark = pytest.mark.slow

FRAMES = 24
WAYS = {
    "still": np.zeros((FRAMES, 2)),
    "elsewhere": np.full((FRAMES, 2), 10.0),
    "bumped": along((12, 0), (1, 8.0), (11, 0)),
    "drifting": along((FRAMES, 0.4)),
    "moving": along((FRAMES, 3.0)),
}


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("moved") / "moved"
    names = ["height", "width", "channels"]
    dataset = LeRobotDataset.create(
        "local/moved",
        10,
        {
            "observation.state": {"dtype": "float32", "shape": (1,), "names": ["x"]},
            "action": {"dtype": "float32", "shape": (1,), "names": ["x"]},
            FRONT: {"dtype": "image", "shape": (HEIGHT, WIDTH, 3), "names": names},
        },
        root=root,
        use_videos=False,
    )
    for shifts in WAYS.values():
        for t, picture in enumerate(panned(shifts, arm=lambda t: (30 + 2 * t, 60 + 2 * t))):
            state = np.array([t / FRAMES], np.float32)
            frame = {"observation.state": state, "action": state, FRONT: picture.numpy(), "task": "wait"}
            dataset.add_frame(frame)
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


def test_every_episode_says_where_its_camera_stood(
    moved: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new"
    arguments = ("--repo=local/moved", f"--root={moved}", f"--new_root={out}", "--variants=1", "--workers=1")
    assert run(*arguments, *FAST, "--gate.min_expected_db=0", "--include_source=false") == 1
    assert "episode 4 variant 0: observation.images.front: its background moves by" in capfd.readouterr().out
    rows = pq.read_table(out / TABLE).to_pylist()
    camera = {row["source_episode"]: json.loads(row["gate"])["views"][FRONT]["camera"] for row in rows}
    assert sorted(camera) == [0, 1, 2, 3]
    assert camera[0]["drift_px"] < 1
    assert [camera[i]["displaced_px"] for i in range(3)] == pytest.approx([0, 28.3, 0], abs=0.5)
    assert camera[2]["moved"] == [{"frame": 12, "px": pytest.approx(16, abs=0.5)}]
    assert camera[3]["drift_px"] == pytest.approx(17, abs=2)  # the ends do not count
    assert all(camera[i]["stands"] for i in camera)
    page = (out / "report.html").read_text()
    assert f"{FRONT}, episode 1: begins 28" in page
    assert f"{FRONT}, episode 2: moved by 16" in page
    assert f"{FRONT}, episode 3: drifts by" in page
    assert f"{FRONT}, episode 4: it moves" in page


def test_where_no_camera_stands_still_the_recorded_episodes_are_copied(
    moved: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "new"
    arguments = ("--repo=local/moved", f"--root={moved}", f"--new_root={out}", "--episodes=[4]")
    assert run(*arguments, *FAST, "--include_source=false") == 2
    assert not out.exists()
    assert f"{FRONT}: copied as recorded: it moves" in plan_of(*arguments, capfd=capfd)
    assert run(*arguments, *FAST) == 1
    assert f"{FRONT} is copied: its background moves by" in caplog.text
    assert "no new views: no camera stands still" in capfd.readouterr().out
    copy, recorded = (LeRobotDataset("local/moved", root) for root in (out, moved))
    assert len(copy) == FRAMES
    assert torch.equal(copy[FRAMES - 1][FRONT], recorded[5 * FRAMES - 1][FRONT])
    assert (out / "report.html").is_file()


def plan_of(*arguments: str, capfd: pytest.CaptureFixture[str]) -> str:
    assert run(*arguments, *FAST, "--dry_run=true") == 0
    return capfd.readouterr().out
