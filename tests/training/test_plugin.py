"""`lerobot-train` as it is installed, with the plugin: what its batches hold."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from tiny_act import SMALL_ACT

from lerobot_msdyn.training import MixedViews

FRONT = "observation.images.front"
PLUGIN = "--dataset.discover_packages_path=lerobot_msdyn.training.plugin"
# A second plugin, which keeps every batch that the training loop is given.
SPY = """
import atexit, os, torch
from lerobot.scripts import lerobot_train as script

kept, make = [], script.make_pre_post_processors

class Spy:
    def __init__(self, inner): self.inner = inner
    def __getattr__(self, name): return getattr(self.inner, name)
    def __call__(self, batch):
        kept.append({key: batch[key].clone() for key in ("index", "observation.images.front")})
        return self.inner(batch)

def spied(*arguments, **options):
    before, after = make(*arguments, **options)
    return Spy(before), after

script.make_pre_post_processors = spied
atexit.register(lambda: kept and torch.save(kept, os.environ["SPY_FILE"]))
"""


def train(root: Path, folder: Path, views: str | None, *flags: str) -> subprocess.CompletedProcess[str]:
    package = folder / "spy_plugin"
    package.mkdir(exist_ok=True)
    (package / "__init__.py").write_text(SPY)
    path = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": path, "SPY_FILE": str(folder / "batches.pt")}
    if views is not None:
        environment["LEROBOT_MSDYN_VIEWS"] = views
    command = [
        str(Path(sys.executable).with_name("lerobot-train")),
        "--dataset.repo_id=local/desk",
        f"--dataset.root={root}",
        "--policy.type=act",
        "--policy.push_to_hub=false",
        f'--policy.input_features={{"{FRONT}": {{"type": "VISUAL", "shape": [3, 48, 64]}}, '
        '"observation.state": {"type": "STATE", "shape": [6]}}',
        "--policy.discover_packages_path=spy_plugin",
        f"--output_dir={folder / 'run'}",
        *SMALL_ACT,
        *flags,
    ]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=500, env=environment)


@pytest.mark.slow
def test_batches_hold_rendered_views(desk: Path, desk_scenes: Path, tmp_path: Path) -> None:
    views = f"--scenes {desk_scenes} --probability 0.5 --seed 3"
    options = ("--steps=14", "--batch_size=4", "--num_workers=2", "--dataset.episodes=[0,1]")
    done = train(desk, tmp_path, views, PLUGIN, *options)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "training on mixed views: 50 % of the samples of 2 episodes" in done.stdout + done.stderr
    batches = torch.load(tmp_path / "batches.pt")
    assert len(batches) == 14
    dataset = LeRobotDataset("local/desk", root=desk, video_backend="pyav", return_uint8=True, episodes=[0, 1])
    mixed = MixedViews(dataset, desk_scenes, 0.5, seed=3)
    replaced = []
    for number, batch in enumerate(batches):
        mixed.set_epoch(number // 6)  # 24 frames in batches of 4
        for index, image in zip(batch["index"].tolist(), batch[FRONT], strict=True):
            seen = (255 * image).round().to(torch.uint8)
            assert torch.equal(seen, mixed[index][FRONT]), "each sample is what MixedViews says it is"
            replaced.append(not torch.equal(seen, dataset[index][FRONT]))
    assert 0.25 < sum(replaced) / len(replaced) < 0.75
    assert replaced[:24] != replaced[24:48], "epochs differ"


@pytest.mark.slow
def test_without_options_it_says_what_is_missing(desk: Path, tmp_path: Path) -> None:
    done = train(desk, tmp_path, None, PLUGIN)
    assert done.returncode != 0
    assert 'LEROBOT_MSDYN_VIEWS names no scenes; expected LEROBOT_MSDYN_VIEWS="--scenes' in done.stderr


def test_elsewhere_it_refuses() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import lerobot_msdyn.training.plugin"], capture_output=True, text=True, check=False
    )
    assert "no training script of LeRobot is running" in done.stderr
