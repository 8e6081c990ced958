"""Other systems' models of motion, which register as a user's own levels do."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core.cli import parse_config
from lerobot_msdyn.core.config import RIVAL_LEVELS, MotionConfig
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.estimate import motion_from_tracks
from lerobot_msdyn.motion.from_tracks.lift import LiftedTracks
from lerobot_msdyn.motion.model.bases import level_from_motions
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians, rgb_to_sh
from lerobot_msdyn.scene.store import load_scene, save_scene
from lerobot_msdyn.synthetic.bodies import TrackedBody, tracked_body

pytestmark = pytest.mark.slow

PROJECT = Path(__file__).parents[2]


@pytest.fixture
def field(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module of the deformation field; both models are registered."""
    monkeypatch.syspath_prepend(PROJECT / "benchmarks")
    importlib.import_module("rivals").register()
    return sys.modules[MOTION_LEVELS.get("field").__module__]


def bent() -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    time = torch.linspace(0, 1, 10)[:, None]
    return points, points[:, None] + 0.2 * time * torch.tensor([1.0, 0.0, 0.0]) * points[:, None, 1:2]


def test_the_field_learns_a_motion(field: ModuleType) -> None:
    points, xyz = bent()
    learned = field.fit_field(points, xyz, torch.ones(200, 10), steps=300)
    nothing = torch.zeros(200, 0, dtype=torch.long)
    moved, _ = learned.carry(
        points.expand(10, -1, -1), torch.ones(10, 200, 4), nothing, nothing.float(), torch.arange(10)
    )
    assert (moved.transpose(0, 1) - xyz).norm(dim=-1).mean() < 0.01
    again = field.fit_field(points, xyz, torch.ones(200, 10), steps=300)
    assert torch.equal(learned.last, again.last)


def test_without_observations_the_field_moves_nothing(field: ModuleType) -> None:
    points, xyz = bent()
    untaught = field.fit_field(points, xyz, torch.zeros(200, 10), steps=5)
    nothing = torch.zeros(200, 0, dtype=torch.long)
    still = torch.nn.functional.normalize(torch.ones(1, 200, 4), dim=-1)
    moved, turned = untaught.carry(points[None], still, nothing, nothing.float(), torch.tensor([3.0]))
    torch.testing.assert_close(moved[0], points)
    torch.testing.assert_close(turned, still)


def error_mm(body: TrackedBody, config: MotionConfig) -> tuple[float, tuple]:
    """Mean distance from the truth of the true canonical points, carried to every frame; and the indices of each."""
    instance = torch.ones(len(body.seen), dtype=torch.long)
    tracks = LiftedTracks(body.seen, body.valid, body.valid.float(), instance, pixel_m=0.002)
    motion = motion_from_tracks(tracks, config)
    assert motion.names == tuple(config.levels)
    frames = torch.arange(body.truth.shape[1])
    moved, _ = motion.moved(body.truth[:, motion.canonical_frame], motion.part, frames)
    error = float(1000 * (moved.transpose(0, 1) - body.truth).norm(dim=-1).mean())
    return error, motion.bind(motion.points, motion.part)[0]


@pytest.mark.parametrize("model", ["flat", "field"])
@pytest.mark.usefixtures("field")
def test_they_explain_a_deformation(model: str) -> None:
    body = tracked_body("deformable", tracks=600)
    error, indices = error_mm(body, MotionConfig(levels=[model], max_parts=1))
    assert error < 4
    if model == "flat":
        assert indices[0].shape == (600, 10)
        few = MotionConfig(levels=[model], max_parts=1, settings={"flat": {"bases": 2}})
        fewer_error, fewer = error_mm(body, few)
        assert fewer[0].shape == (600, 2)
        assert fewer_error > error


def test_a_scene_with_a_field_is_saved_and_loaded(field: ModuleType, tmp_path: Path) -> None:
    points, xyz = bent()
    learned = field.fit_field(points, xyz, torch.ones(200, 10), steps=2)
    gaussians = Gaussians(
        points, torch.ones(200, 4), torch.zeros(200, 3), torch.zeros(200), rgb_to_sh(torch.ones(200, 3))
    )
    objects = level_from_motions(torch.eye(4).repeat(1, 10, 1, 1), torch.zeros(1, 3))
    nothing = torch.zeros(200, 0)
    scene = DynamicScene(
        gaussians,
        gaussians,
        (objects, learned),
        (torch.zeros(200, 1).long(), nothing.long()),
        (torch.zeros(200, 1), nothing),
        frames=10,
    )
    save_scene(scene, tmp_path / "scene.safetensors")
    again = load_scene(tmp_path / "scene.safetensors")
    assert [level.kind for level in again.levels] == ["bases", "field"]
    assert torch.equal(again.at(torch.tensor([1, 7])).means, scene.at(torch.tensor([1, 7])).means)


def test_without_the_plugin_one_line_names_it(tmp_path: Path) -> None:
    """In a process of its own, where nothing has registered them."""
    file, header = tmp_path / "scene.safetensors", json.dumps({"schema": 3, "levels": ["field"], "frames": 1})
    save_file({}, file, metadata={"lerobot_msdyn": header})
    code = (
        "from pathlib import Path\n"
        "from lerobot_msdyn.core.config import MotionConfig\n"
        "from lerobot_msdyn.core.fields import problems\n"
        "from lerobot_msdyn.scene.store import load_scene\n"
        "print(*problems(MotionConfig(levels=['flat']), 'motion.'), sep='\\n')\n"
        f"try: load_scene(Path({str(file)!r}))\n"
        "except Exception as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PROJECT)
    config, scene = done.stdout.splitlines()
    assert re.fullmatch(r"motion.levels is \[flat\]; expected some of .*--plugins benchmarks/rivals/flat.py", config)
    assert re.match(rf"{re.escape(str(file))}: its motion is of kind 'field', .*benchmarks/rivals/field.py", scene)


def test_the_plugins_that_are_named_exist_and_register() -> None:
    for name, file in RIVAL_LEVELS.items():
        arguments = ["--plugins", str(PROJECT / file), "--motion.levels", f"[{name}]"]
        assert parse_config(AugmentConfig, arguments, {}, command="augment").motion.levels == [name]


@pytest.mark.usefixtures("field")
def test_they_stand_alone() -> None:
    for levels in (["flat", "object"], ["object", "flat"], ["field", "primitive"], ["flat", "grain"]):
        assert problems(MotionConfig(levels=levels), "motion.") != []
        with pytest.raises(ConfigError, match=r"motion\.levels is .*; expected"):
            motion_from_tracks(
                LiftedTracks(torch.zeros(1, 3, 3), torch.ones(1, 3) > 0, torch.ones(1, 3), torch.ones(1).long(), 0.002),
                MotionConfig(levels=levels),
            )


def test_wrong_settings_are_named(field: ModuleType) -> None:
    wrong: list[tuple[dict[str, dict[str, Any]], str]] = [
        ({"flat": {"bases": 0}}, r"settings\.flat\.bases is 0; expected a value from 1 to 10000"),
        ({"flat": {"basis": 3}}, r"settings\.flat: .*`basis` are not valid"),
        ({"flat": {"bases": "many"}}, r"settings\.flat: `bases`: Couldn't parse 'many'"),
        ({"grain": {"bases": 3}}, r"settings\.grain: level grain has no settings of its own"),
        ({"wavelet": {}}, r"settings\.wavelet: expected some of .*flat.*add --plugins FILE.py"),
    ]
    for settings, message in wrong:
        (line,) = problems(MotionConfig(settings=settings), "motion.")
        assert re.match(rf"motion\.{message}", line), line
