"""Sequences from the command line: fitted, rendered and scored by both protocols."""

import importlib
import json
from dataclasses import replace
from pathlib import Path

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


def test_the_table_of_five_sequences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From scores that are there already: means over all five, beside published rows of the same protocol only."""
    monkeypatch.syspath_prepend(Path(__file__).parent.parent.parent / "benchmarks")
    benchmark = importlib.import_module("dycheck")
    for i, name in enumerate(benchmark.SEQUENCES):
        (tmp_path / name).mkdir()
        mean = {"this fit": {"mpsnr": 15.0 + i, "mssim": 0.6}}
        (tmp_path / name / "scores.json").write_text(json.dumps({"protocol": "som", "mean": mean}))
    arguments = ["--data", str(tmp_path), "--out", str(tmp_path)]
    assert benchmark.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "| this fit, spin | 18.00 | 0.600 | - |" in printed
    assert "| this fit, mean | 17.00 | 0.600 | - |" in printed
    assert "| published: the paper | 17.07 | 0.66 | 0.38 |" in printed
    assert "T-NeRF (DyCheck)" not in printed
    with pytest.raises(ConfigError, match="is of protocol som, not dycheck"):
        benchmark.main([*arguments, "--protocol", "dycheck"])
    assert benchmark.main([*arguments, "--sequences", "apple", "spin"]) == 0
    assert "this fit, mean" not in capsys.readouterr().out
