"""Sequences from the command line: fitted, rendered and scored by both protocols."""

import importlib
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from pictures import read_picture

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.evaluate import __main__ as evaluate
from lerobot_msdyn.evaluate.config import DycheckConfig, Protocol
from lerobot_msdyn.evaluate.dycheck.iphone import read_sequence
from lerobot_msdyn.evaluate.metrics import masked_psnr_db, partial_ssim

FAST = ("--fit.steps", "30", "--scene.moving_frames", "4", "--scene.overlay", "false")


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["som", "dycheck"])
def test_the_fit_beats_the_recorded_picture(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], protocol: Protocol
) -> None:
    if protocol == "som":
        pytest.importorskip("pycolmap")
    arguments = ["dycheck", "--root", str(sequence), "--out", str(tmp_path), "--protocol", protocol]
    assert evaluate.run([*arguments, *FAST]) == 0
    printed = capsys.readouterr().out
    assert f"protocol {protocol}" in printed
    assert "mLPIPS is left out" in printed
    written = json.loads((tmp_path / "scores.json").read_text())
    fitted, unchanged = written["mean"]["this fit"], written["mean"]["recorded picture of that time"]
    assert fitted["mpsnr"] > unchanged["mpsnr"] + 2
    assert fitted["mssim"] > unchanged["mssim"]
    truth = read_sequence(sequence, protocol)
    assert sorted(path.stem for path in (tmp_path / "rgb").iterdir()) == sorted(truth.validation)
    for name in truth.validation:  # the scores are those of the pictures that were written
        rendered = read_picture(tmp_path / "rgb" / f"{name}.png")
        true, mask = truth.true_picture(name), truth.covisible(name)
        assert written["images"][name]["mpsnr"] == pytest.approx(masked_psnr_db(rendered, true, mask), abs=1e-4)
        assert written["images"][name]["mssim"] == pytest.approx(partial_ssim(rendered, true, mask), abs=1e-4)
    means = {score: np.mean([image[score] for image in written["images"].values()]) for score in fitted}
    assert fitted == pytest.approx(means, abs=1e-4)


def test_it_takes_the_papers_method_where_no_recipe_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[DycheckConfig] = []

    def keep(config: DycheckConfig) -> str:
        seen.append(config)
        return ""

    kind = replace(evaluate.EVALUATIONS["dycheck"], run=keep)
    monkeypatch.setitem(evaluate.EVALUATIONS, "dycheck", kind)
    arguments = ["dycheck", "--root", "there", "--out", "here"]
    evaluate.run([*arguments, "--fit.steps", "7"])
    evaluate.run([*arguments, "--recipe", "quick"])
    paper, quick = seen
    assert paper.fit.learn.bases
    assert paper.fit.weights["track"] > 0
    assert not paper.scene.overlay
    assert paper.fit.steps == 7
    assert not quick.fit.learn.bases


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(Path(__file__).parent.parent.parent / "benchmarks")
    return importlib.import_module("dycheck")


def keep_scores(out: Path, mpsnr: float) -> None:
    """As a run of protocol som leaves them."""
    out.mkdir(parents=True)
    mean = {"this fit": {"mpsnr": mpsnr, "mssim": 0.6}, "recorded picture of that time": {"mpsnr": 9.0}}
    (out / "scores.json").write_text(json.dumps({"protocol": "som", "mean": mean}))


def test_the_table_of_five_sequences(benchmark: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From scores that are there already: means over all five, beside published rows of the same protocol only."""
    for i, name in enumerate(benchmark.SEQUENCES):
        keep_scores(tmp_path / "paper" / name, 15.0 + i)
        keep_scores(tmp_path / "balanced" / name, 16.0 + i)
    five = ["--data", str(tmp_path), "--out", str(tmp_path), "--sequences", *benchmark.SEQUENCES]
    assert benchmark.main([*five, "--recipes", "paper", "balanced"]) == 0
    printed = capsys.readouterr().out
    assert "| paper, spin | 18.00 | 0.600 | - |" in printed
    assert "| paper, mean of the five | 17.00 | 0.600 | - |" in printed
    assert "| balanced, mean of the five | 18.00 | 0.600 | - |" in printed
    assert printed.count("| recorded picture of that time, mean of the five | 9.00 | - | - |") == 1
    assert "| published: the paper | 17.07 | 0.66 | 0.38 |" in printed
    assert "T-NeRF (DyCheck)" not in printed
    with pytest.raises(ConfigError, match="is of protocol som, not dycheck"):
        benchmark.main([*five, "--protocol", "dycheck"])
    assert benchmark.main([*five[:-5], "apple", "spin"]) == 0
    printed = capsys.readouterr().out
    assert "| paper, mean of 2 | 16.50 | 0.600 | - |" in printed
    assert "published" not in printed


def test_a_command_per_row_and_one_for_the_table(
    benchmark: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever sequences there are; one without validation is not among them, one that is scored is not run again."""
    for name, picture in (("cup", "1_00000"), ("fan", "2_00004"), ("cat", "0_00000")):
        (tmp_path / name / "rgb" / "2x").mkdir(parents=True)
        (tmp_path / name / "rgb" / "2x" / f"{picture}.png").touch()
    ran: list[list[str]] = []

    def run(arguments: list[str]) -> int:
        ran.append(arguments)
        keep_scores(Path(arguments[arguments.index("--out") + 1]), 20.0)
        return 0

    monkeypatch.setattr(benchmark.evaluate, "run", run)
    arguments = ["--data", str(tmp_path), "--out", str(tmp_path / "out")]
    keep_scores(tmp_path / "out" / "balanced" / "cup", 30.0)
    assert benchmark.main([*arguments, "--recipes", "balanced", "--", "--fit.steps", "7"]) == 0
    out = tmp_path / "out" / "balanced" / "fan"
    flags = ["--recipe", "balanced", "--protocol", "som", "--fit.steps", "7"]
    assert ran == [["dycheck", "--root", str(tmp_path / "fan"), "--out", str(out), *flags]]
    capsys.readouterr()
    assert benchmark.main([*arguments, "--recipes", "paper", "balanced", "--table"]) == 0
    printed = capsys.readouterr().out
    assert "| balanced, mean of 2 | 25.00 | 0.600 | - |" in printed
    assert "paper" not in printed
    with pytest.raises(ConfigError, match="has no scores of paper; run without --table first"):
        benchmark.main([*arguments, "--table"])
    with pytest.raises(ConfigError, match="holds no sequence with pictures that validate"):
        benchmark.main(["--data", str(tmp_path / "cat"), "--out", str(tmp_path / "out")])
    assert len(ran) == 1
