"""A kind of camera change of the user's own, from a file that only the command line names."""

import json
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from lerobot.datasets import LeRobotDataset

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core import plugins
from lerobot_msdyn.core import registry as registry_module
from lerobot_msdyn.core.cli import load_recipe, parse_config
from lerobot_msdyn.core.command_help import format_help
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.perturbation import PERTURBATIONS, Perturbation
from lerobot_msdyn.training import MixedViews
from lerobot_msdyn.views.perturbations.orbit import Orbit

pytestmark = pytest.mark.slow

PLUGIN = Path(__file__).parents[2] / "examples" / "03_own_perturbation.py"
FRONT = "observation.images.front"
FAST = {
    "fit.steps": 8,
    "fit.max_width": 48,
    "scene.moving_gaussians": 500,
    "scene.moving_frames": 4,
    "max_unseen": 1,
    "gate.enabled": "false",
}


@pytest.fixture
def plugin() -> Iterator[list[str]]:
    """The flag that imports the plugin, which is forgotten afterwards."""
    yield ["--plugins", str(PLUGIN)]
    swing = PERTURBATIONS._registered.pop("swing", None)
    plugins._imported.pop(str(PLUGIN.resolve()), None)
    if swing is not None:
        sys.modules.pop(swing.__module__, None)


def augmented(desk: Path, out: Path, flags: list[str]) -> list[np.ndarray]:
    """Poses (new camera from recorded one) of the new episodes, [4,4] or one for each frame."""
    source = {"repo": "local/desk", "root": desk, "new_root": out, "episodes": "[0]", "cameras": "[front]"}
    options = source | FAST | {"include_source": "false", "perturbation.type": "swing"}
    assert augment.run([*(f"--{name}={value}" for name, value in options.items()), *flags]) == 0
    rows = pq.read_table(out / "meta" / "msdyn" / "episodes.parquet").to_pylist()
    return [np.array(json.loads(row["views"])[FRONT]["camera_from_source"]) for row in rows]


def turns_deg(poses: np.ndarray) -> np.ndarray:
    """By how much each of the poses [t,4,4] is turned, positive to the left."""
    angles = np.degrees(np.arccos((np.trace(poses[:, :3, :3], axis1=1, axis2=2) - 1) / 2))
    return np.asarray(np.sign(poses[:, 0, 2]) * angles)


def test_one_file_is_a_kind_of_its_own(desk: Path, tmp_path: Path, plugin: list[str]) -> None:
    flags = [*plugin, "--variants", "2", "--perturbation.azimuth_deg", "10"]
    swings = augmented(desk, tmp_path / "new", flags)
    assert [swing.shape for swing in swings] == [(12, 4, 4)] * 2
    for swing in swings:
        turns = turns_deg(swing)
        assert 9 < np.abs(turns).max() < 10.01
        assert turns.min() < -5
        assert turns.max() > 5
        assert np.abs(np.diff(turns)).max() < 7, "smooth"
    first, second = swings
    assert not np.allclose(first, second)
    dataset = LeRobotDataset("local/desk_msdyn", root=tmp_path / "new", video_backend="pyav")
    assert (dataset[0][FRONT] - dataset[6][FRONT]).abs().mean() > 0.01
    recipe = yaml.safe_load((tmp_path / "new" / "meta" / "msdyn" / "recipe.yaml").read_text())
    assert recipe["perturbation"] == {"type": "swing", "per_frame": False, "azimuth_deg": 10.0}


def test_with_per_frame_every_frame_has_its_own_sample(desk: Path, tmp_path: Path, plugin: list[str]) -> None:
    (poses,) = augmented(desk, tmp_path / "new", [*plugin, "--variants", "1", "--perturbation.per_frame", "true"])
    assert sorted(np.floor((turns_deg(poses) + 15) / 30 * 4).astype(int).tolist()) == sorted([0, 1, 2, 3] * 3)


def test_flags_are_checked_and_explained(plugin: list[str]) -> None:
    def parse(*flags: str) -> Perturbation:
        return parse_config(
            AugmentConfig, [*plugin, "--perturbation.type", "swing", *flags], {}, command="a"
        ).perturbation

    assert parse("--perturbation.azimuth_deg", "3").type_name == "swing"
    with pytest.raises(ConfigError, match=r"perturbation.azimuth_deg is 120.0; expected a value from 0 to 90"):
        parse("--perturbation.azimuth_deg", "120")
    with pytest.raises(ConfigError, match=r"unknown field 'perturbation.elevation_deg'"):
        parse("--perturbation.elevation_deg", "3")
    assert "--perturbation.type swing: Swing the camera" in format_help(AugmentConfig, {}, "a")


def test_help_lists_plugins(plugin: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse_config(AugmentConfig, [*plugin, "--help-all"], {}, command="a")
    assert "--perturbation.type swing: Swing the camera" in capsys.readouterr().out


def test_a_recipe_imports_nothing(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("perturbation: {type: swing}\n")
    with pytest.raises(ConfigError, match=r"perturbation.type is 'swing'; expected one of dolly, drift"):
        load_recipe(str(recipe))
    recipe.write_text(f"plugins: {PLUGIN}\n")
    with pytest.raises(ConfigError, match="unknown field 'plugins'"):
        load_recipe(str(recipe))


def test_two_kinds_of_one_name_are_refused() -> None:
    with pytest.raises(ConfigError, match="perturbation 'orbit' is registered twice"):

        @Perturbation.register_subclass("orbit")
        class Another(Perturbation):
            pass

    assert PERTURBATIONS.get("orbit") is Orbit


def test_installed_packages_bring_kinds_by_entry_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "shaking.py").write_text(PLUGIN.read_text().replace('"swing"', '"shaking"'))
    (tmp_path / "shaking-1.0.dist-info").mkdir()
    (tmp_path / "shaking-1.0.dist-info" / "METADATA").write_text("Name: shaking\nVersion: 1.0\n")
    points = "[lerobot_msdyn.views.perturbations]\nshaking = shaking:Swing\nbroken = absent:Kind\n"
    (tmp_path / "shaking-1.0.dist-info" / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(PERTURBATIONS, "_registered", dict(PERTURBATIONS._registered))
    monkeypatch.setattr(registry_module, "_all_entry_points", registry_module._all_entry_points.__wrapped__)
    assert parse_config(AugmentConfig, ["--perturbation.azimuth_deg", "3"], {}, command="a").perturbation == Orbit(
        azimuth_deg=3.0
    )
    assert "shaking" not in sys.modules, "imported only where it is named"
    flags = ["--perturbation.type", "shaking", "--perturbation.azimuth_deg", "3"]
    assert parse_config(AugmentConfig, flags, {}, command="a").perturbation.type_name == "shaking"
    with pytest.raises(
        ConfigError, match=r"perturbation 'broken': absent:Kind cannot be imported \(ModuleNotFoundError: No module"
    ):
        parse_config(AugmentConfig, ["--perturbation.type", "broken"], {}, command="a")


def azimuth_of(perturbation: Perturbation) -> float:
    """Run in another process."""
    return perturbation.azimuth_deg


def test_other_processes_import_the_plugin_first(plugin: list[str]) -> None:
    flags = [*plugin, "--perturbation.type", "swing", "--perturbation.azimuth_deg", "7"]
    swing = parse_config(AugmentConfig, flags, {}, command="a").perturbation
    assert pickle.loads(pickle.dumps(swing)) == swing
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        assert pool.submit(azimuth_of, swing).result() == 7.0


def test_from_the_command_line_with_several_workers(desk: Path, tmp_path: Path) -> None:
    flags = {"repo": "local/desk", "root": desk, "new_root": tmp_path / "new", "episodes": "[0,1]", "workers": 2}
    flags |= FAST | {"cameras": "[front]", "variants": 1, "plugins": PLUGIN, "perturbation.type": "swing"}
    command = [sys.executable, "-m", "lerobot_msdyn.augment", *(f"--{name}={value}" for name, value in flags.items())]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=os.environ | {"HF_HUB_OFFLINE": "1"}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "2 of 2 episodes, 2 new ones" in done.stdout


def test_scenes_saved_with_a_kind_that_is_not_here(desk: Path, desk_scenes: Path, tmp_path: Path) -> None:
    shutil.copytree(desk_scenes, tmp_path / "new")
    path = tmp_path / "new" / "meta" / "msdyn" / "recipe.yaml"
    recipe = yaml.safe_load(path.read_text()) | {"perturbation": {"type": "swing", "azimuth_deg": 4.0}}
    recipe["priors"]["depth"] = "of_another_plugin"  # which is not needed here
    path.write_text(yaml.safe_dump(recipe))
    dataset = LeRobotDataset("local/desk", root=desk, video_backend="pyav")
    with pytest.raises(ConfigError, match=r"recipe.yaml: perturbation.type is 'swing', which is not known") as caught:
        MixedViews(dataset, tmp_path / "new")
    assert "\n" not in str(caught.value)
    assert "--plugins" in str(caught.value)
    assert MixedViews(dataset, tmp_path / "new", perturbation=Orbit()).mixer.perturbation == Orbit()


def test_training_on_views_of_a_kind_of_its_own(
    desk: Path, desk_scenes: Path, tmp_path: Path, plugin: list[str]
) -> None:
    plugins.import_plugins(plugin[1:])
    swing = PERTURBATIONS.get("swing")(azimuth_deg=6.0)
    dataset = LeRobotDataset("local/desk", root=desk, video_backend="pyav")
    mixed = MixedViews(dataset, desk_scenes, 1.0, swing)
    assert (mixed[3][FRONT] - dataset[3][FRONT]).abs().mean() > 0.005
