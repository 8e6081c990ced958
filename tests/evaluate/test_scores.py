"""Scores of views: which pixels count for what, and the table."""

import dataclasses
import importlib.util
import json
import math
from pathlib import Path

import numpy as np
import pytest

from lerobot_msdyn.evaluate.nvs import read_truth
from lerobot_msdyn.evaluate.scores import Evaluated, TrueViews, dynamic_psnr_db, mean_scores, score_table, score_views
from lerobot_msdyn.reconstruction.account import Account, account_line
from lerobot_msdyn.scene.sources import MovingPixels

SIZE = (2, 40, 50)


def views() -> tuple[np.ndarray, TrueViews]:
    """Pictures whose error is 10 where nothing moves, 20 where something does, 40 where seen at another time only."""
    random = np.random.default_rng(0)
    true = random.integers(50, 200, (*SIZE, 3)).astype(np.uint8)
    error, seen, moving = np.full(SIZE, 10), np.full(SIZE, 2, np.uint8), np.zeros(SIZE, bool)
    moving[:, :10, :10], error[:, :10, :10] = True, 20
    seen[:, 20:, :10], error[:, 20:, :10] = 1, 40
    seen[:, :, 40:], error[:, :, 40:] = 0, 50
    return (true + error[..., None]).astype(np.uint8), TrueViews(true, seen, moving)


def decibels(error: float) -> float:
    return 10 * math.log10(255**2 / error)


def test_each_score_is_over_its_own_pixels() -> None:
    found = score_views(*views())
    assert found["dyn_psnr"] == pytest.approx(decibels(20**2))
    assert found["dis_psnr"] == pytest.approx(decibels(40**2))
    still, moving, other = 1600 - 100 - 200, 100, 200
    mean = (still * 10**2 + moving * 20**2 + other * 40**2) / 1600
    assert found["psnr"] == pytest.approx(decibels(mean))
    assert found["flicker"] == 0
    assert 0 < found["dyn_ssim"] < 1


def test_dynamic_psnr_alone_is_that_among_the_scores() -> None:
    rendered, true = views()
    assert dynamic_psnr_db(rendered, true) == pytest.approx(score_views(rendered, true)["dyn_psnr"])
    assert math.isnan(dynamic_psnr_db(rendered, dataclasses.replace(true, moving=None)))
    still = dataclasses.replace(true, moving=np.zeros(SIZE, bool))
    assert math.isnan(dynamic_psnr_db(rendered, still))


def test_what_no_frame_shows_has_no_score() -> None:
    drawn, true = views()
    found = score_views(drawn, TrueViews(true.rgb, np.full(SIZE, 2, np.uint8)))
    assert "dis_psnr" not in found
    assert "dyn_psnr" not in found
    assert mean_scores([{"psnr": 10.0, "flicker": math.nan}, {"psnr": 20.0}]) == {"psnr": 15.0}


def test_table_and_file(tmp_path: Path) -> None:
    table = score_table({"az+05": {"psnr": 21.234, "ssim": 0.71234}, "mean": {"psnr": 21.234}})
    assert table.splitlines()[2:] == ["| az+05 | 21.23 | 0.712 |", "| mean | 21.23 | - |"]
    shares = {"by_motion": 0.234, "by_overlay": 0.766, "dyn_psnr": 21.0, "dyn_psnr_without_overlay": 17.0}
    table_of_sources = score_table({"az+05": shares}).splitlines()
    assert table_of_sources[0] == "| camera | dynamic PSNR | without overlay | by motion | by overlay |"
    assert table_of_sources[2] == "| az+05 | 21.00 | 17.00 | 23 % | 77 % |"
    account = Account(MovingPixels(10, 0, 90), 1e-3, 1e-2, held_out=True)
    content = {
        "what_moves": account.entry(),
        "mean": {"psnr": math.inf, "ssim": 0.123456789},
        "seconds": {"fit": 1.0},
        "notices": ["no"],
        "pictures": 3,
    }
    text = Evaluated(content, table, tmp_path / "out").written().text()
    assert json.loads((tmp_path / "out" / "scores.json").read_text())["mean"] == {"psnr": None, "ssim": 0.12346}
    assert "3 pictures and scores.json written" in text
    assert table.splitlines()[0] in text
    assert f"recorded camera: {account_line(account)}" in text


def test_scores_agree_with_the_scorer_of_the_data(shared_data: Path) -> None:
    """`score.py` of the simulated scenes, on two frames of one camera with some noise."""
    path = shared_data / "sim" / "score.py"
    if not path.is_file():
        pytest.skip("no simulated scenes beside the checkout")
    spec = importlib.util.spec_from_file_location("sim_score", path)
    assert spec is not None
    assert spec.loader is not None
    scorer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(scorer)
    truth = read_truth(shared_data / "sim" / "rigid_push", "az+05")
    assert truth is not None
    assert truth.moving is not None
    moving = truth.moving[8:10]
    some = TrueViews(truth.rgb[8:10], truth.seen[8:10], moving)
    noise = np.random.default_rng(0).normal(0, 12, some.rgb.shape)
    drawn = (some.rgb + noise).clip(0, 255).astype(np.uint8)
    found = score_views(drawn, some)
    theirs = [scorer.score_frame(drawn[i], some.rgb[i], some.seen[i], moving[i].astype(int), [1]) for i in range(2)]
    for name in ("psnr", "ssim", "dyn_psnr", "dyn_ssim", "dis_psnr"):
        assert found[name] == pytest.approx(np.mean([one[name] for one in theirs]), abs=1e-4), name
