"""The examples run as they stand, at a small size, and are short enough to read."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.py"))
IN_CI = "01_demo.py"  # make demo
SAYS = {
    "02_augment.py": r"2 episodes: the recorded one",
    "03_own_perturbation.py": r"four of 8 frames of the swing",
    "04_own_prior.py": r"'depth': 'file'.*\n.* dB on the recorded camera",
    "05_train_mixed.py": r"4 updates, 2 epochs, loss \d",
    "06_held_out_camera.py": r"(?s)\d dB\n.*\d dB\n",
    "07_export_scene.py": r"frame_000000.ply to frame_000007.ply",
    "08_own_motion_level.py": r"\d parts, [1-9]\d* cells, \d+ moving Gaussians",
    "10_own_loss.py": r"(?s)weight 0: longest axis .*\nweight 0.01: longest axis",
    "09_own_depth.py": r"'provider': 'two_walls', 'why': 'asked for; walls at 0.96 and 1.2 m', 'model': 'me/two-walls'",
}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_numbered_and_short(path: Path) -> None:
    assert re.match(r"\d\d_", path.name)
    assert len(path.read_text().splitlines()) < 80


@pytest.mark.parametrize("path", [path for path in EXAMPLES if path.name != IN_CI], ids=lambda path: path.stem)
def test_example_runs(path: Path, tmp_path: Path) -> None:
    small = ["--out", str(tmp_path), "--frames", "8", "--steps", "4"]
    small += ["--updates", "4"] if "updates" in path.read_text() else []
    environment = os.environ | {"HF_HUB_OFFLINE": "1"}
    done = subprocess.run(
        [sys.executable, str(path), *small], capture_output=True, text=True, check=False, timeout=400, env=environment
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert re.search(SAYS[path.name], done.stdout), done.stdout
