"""The benchmark of made-up arms: what it counts, and that it goes on where it stopped."""

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from filmed_arm import camera

from lerobot_msdyn.robots.calibration.search import angle_between


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("yourdfpy")
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    return importlib.import_module("robot_cameras")


def row(seed: int, doubt: str = "", wrong: bool = False) -> dict[str, Any]:
    names = (
        "turned_deg",
        "apart",
        "focal",
        "depth",
        "sd_turned_deg",
        "sd_apart",
        "sd_focal",
        "hits",
        "margin",
        "cpu_s",
    )
    return dict.fromkeys(names, 0.01) | {"case": "random", "seed": seed, "doubt": doubt, "wrong": wrong}


def test_a_results_file_is_gone_on_with(
    benchmark: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tried = []

    def one(name: str, seed: int, folder: Path) -> dict[str, Any]:
        tried.append(seed)
        return row(seed, "too far" if seed == 1 else "", seed in (1, 2))

    monkeypatch.setattr(benchmark, "one", one)
    for count in ("2", "4"):
        monkeypatch.setattr(sys, "argv", ["robot_cameras.py", "--count", count, "--results", str(tmp_path / "r.jsonl")])
        benchmark.main()
    assert tried == [0, 1, 2, 3]
    expected = "4 cameras: 3 believed, of which 1 are wrong; 1 doubted, of which 0 are right; 2 wrong in all"
    assert expected in capsys.readouterr().out


def test_the_zero_of_the_first_joint_is_no_error(benchmark: ModuleType) -> None:
    true, angle = camera(-50, 25, 0.9, 50), np.radians(7)
    about = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    found = benchmark.replace(true, rotation=true.rotation @ about)
    assert angle_between(found.rotation, true.rotation) == pytest.approx(angle)
    back = benchmark._turned_back(found, true)
    assert angle_between(back.rotation, true.rotation) == pytest.approx(0, abs=1e-6)


def test_a_state_that_is_recorded_badly_is_so_by_what_is_said(benchmark: ModuleType, tmp_path: Path) -> None:
    case = benchmark.made("disturbed", 3, tmp_path)
    shares = benchmark.in_units(case.robot, benchmark.map_joints(case.robot, benchmark.NAMES, case.state), "normalised")
    off = np.degrees(shares.values(case.state)[:-1] - case.values[1:])[:, :5]
    fit = [np.polyfit(np.degrees(case.values[1:, k]), off[:, k], 1, full=True) for k in range(5)]
    assert [abs(line[0][0]) for line in fit] == pytest.approx([0.03] * 5, abs=0.015)
    assert [np.sqrt(line[1][0] / len(off)) for line in fit] == pytest.approx([1.0] * 5, abs=0.4)
