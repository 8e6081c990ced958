"""Motion levels by name: those of the package, their order, and one of a user's own, from a file."""

import re
from pathlib import Path

import pytest
import torch
from motion_levels import of_bases
from torch import Tensor

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.motion.estimate import motion_from_tracks
from lerobot_msdyn.motion.from_tracks.clusters import spread_nodes
from lerobot_msdyn.motion.from_tracks.lift import LiftedTracks
from lerobot_msdyn.motion.model.bases import MotionLevel, level_affines
from lerobot_msdyn.motion.model.binding import nearest_bases
from lerobot_msdyn.motion.model.scene_motion import SceneMotion, bind
from lerobot_msdyn.motion.spec import (
    FinerLevel,
    FirstLevel,
    PartTracks,
    finer_level,
    first_level,
    frames_per_knot,
    level_spec,
)
from lerobot_msdyn.scene import store
from lerobot_msdyn.synthetic.bodies import TrackedBody, tracked_body

FRONT = "observation.images.front"
PLUGIN = Path(__file__).parents[2] / "examples" / "08_own_motion_level.py"


@MOTION_LEVELS.register("halves")
class Halves(FinerLevel):
    """Two bases per part; may stand after particles as well, and grains after it."""

    after = ("object", "particle")
    before = ("grain",)
    frames_per_knot = 3

    def cluster(self, tracks, config, noise) -> Tensor:
        return spread_nodes(tracks.points, 2)

    def bind(self, level: MotionLevel, points, part, coarser) -> tuple[Tensor, Tensor]:
        return nearest_bases(level, points, part[:, None], 2)


@MOTION_LEVELS.register("whole")
class Whole(FirstLevel):
    """Everything follows the first part."""

    def estimate(self, tracks: PartTracks, config: MotionConfig) -> MotionLevel:
        return tracks.objects

    def bind(self, level: MotionLevel, points, part, coarser) -> tuple[Tensor, Tensor]:
        return torch.zeros(len(points), 1, dtype=torch.long), torch.zeros(len(points), 1)


@pytest.fixture(scope="module")
def body() -> TrackedBody:
    return tracked_body("deformable", tracks=300, frames=30)


def fitted(body: TrackedBody, config: MotionConfig) -> SceneMotion:
    tracks = LiftedTracks(body.seen, body.valid, body.valid.float(), torch.ones(len(body.seen)).long(), pixel_m=0.002)
    return motion_from_tracks(tracks, config)


def error_mm(motion: SceneMotion, body: TrackedBody) -> float:
    frames = torch.arange(body.truth.shape[1])
    moved, _ = motion.moved(body.truth[:, motion.canonical_frame], motion.part, frames)
    return float(1000 * (moved.transpose(0, 1) - body.truth).norm(dim=-1).mean())


def test_every_file_of_the_folder_registers_its_name() -> None:
    built_in = {"object", "primitive", "grain", "particle"}
    assert built_in <= set(MOTION_LEVELS.names())
    assert {type(level_spec(name)).__module__.rsplit(".", 1)[-1] for name in built_in} == built_in
    assert [frames_per_knot(name, MotionConfig()) for name in ("object", "primitive", "grain", "particle")] == [
        1,
        2,
        4,
        4,
    ]


@pytest.mark.parametrize(
    ("levels", "message"),
    [
        ("object", None),
        ("object primitive", None),
        ("object particle", None),
        ("object primitive grain particle", None),
        ("object primitive particle", None),
        ("object halves", None),
        ("object halves grain", None),  # halves says so
        ("object particle halves", None),
        ("", "expected at least one level"),
        ("primitive", "expected primitive right after object"),
        ("object grain", "expected grain right after primitive, not after object"),
        ("object primitive primitive", "expected primitive right after object, not after primitive"),
        ("object particle grain", "expected grain right after primitive, not after particle"),
        ("object object", "expected object in the first place, not after object"),
        ("object primitive halves", "expected halves right after object or particle, not after primitive"),
        ("whole primitive", "expected primitive right after object, not after whole"),
        ("objects", "expected some of .*grain, .*; objects is none of them: add --plugins FILE.py"),
    ],
)
def test_order(levels: str, message: str | None) -> None:
    lines = problems(MotionConfig(levels=levels.split()), "motion.")
    if message is None:
        assert lines == []
    else:
        assert re.match(rf"motion\.levels is \[{', '.join(levels.split())}\]; {message}", lines[0]), lines


def test_the_wrong_order_is_refused_before_any_work(body: TrackedBody) -> None:
    with pytest.raises(ConfigError, match=r"motion\.levels is \[object, grain\]; expected grain right after primitive"):
        fitted(body, MotionConfig(levels=["object", "grain"]))
    with pytest.raises(ConfigError, match=r"motion level 'grain' cannot stand first; it stands after primitive"):
        first_level("grain")
    with pytest.raises(ConfigError, match=r"motion level 'object' stands first"):
        finer_level("object")
    with pytest.raises(ConfigError, match=r"no motion level 'wavelet'; expected one of .*grain"):
        level_spec("wavelet")


def test_a_finer_level_of_ones_own_explains_more(body: TrackedBody) -> None:
    coarse = fitted(body, MotionConfig(levels=["object"], max_parts=1))
    own = fitted(body, MotionConfig(levels=["object", "halves"], max_parts=1, gate=False))
    assert own.names == ("object", "halves")
    halves = of_bases(own.levels)[1]
    assert len(halves) == 2
    assert error_mm(own, body) < 0.9 * error_mm(coarse, body)
    steps = halves.knots.diff()
    assert int(steps.max()) == 3
    often = MotionConfig(levels=["object", "halves"], max_parts=1, gate=False, frames_per_knot={"halves": 1})
    assert int(of_bases(fitted(body, often).levels)[1].knots.diff().max()) == 1


def test_a_first_level_of_ones_own(body: TrackedBody) -> None:
    whole = fitted(body, MotionConfig(levels=["whole"]))
    objects = fitted(body, MotionConfig(levels=["object"]))
    (level,), (expected,) = of_bases(whole.levels), of_bases(objects.levels)
    assert torch.equal(level.displacements, expected.displacements)
    assert set(whole.bind(whole.points, whole.part)[0][0].flatten().tolist()) == {0}
    frame = torch.tensor([7])
    first = level_affines(level, frame)[0, 0]
    moved, _ = whole.moved(whole.points, whole.part, frame)
    torch.testing.assert_close(moved[0], whole.points @ first[:, :3].T + first[:, 3], atol=1e-5, rtol=0)
    back, _ = whole.to_canonical(moved[0], 7, whole.instance)
    torch.testing.assert_close(back, whole.points, atol=1e-4, rtol=0)


def test_grains_follow_those_of_the_nearest_primitives(body: TrackedBody) -> None:
    motion = fitted(body, MotionConfig(max_parts=1, gate=False))
    indices, logits = bind(motion.names, motion.levels, motion.points, motion.part)
    grains = of_bases(motion.levels)[2]
    idle = len(grains) - 1
    assert (indices[2][:, -1] == idle).all()
    assert (logits[2][:, -1] == -4).all()
    nearest = indices[1].gather(1, logits[1].topk(2).indices)
    followed = logits[2][:, :-1] > -30
    parents = grains.parents[indices[2][:, :-1]]
    assert ((parents[..., None] == nearest[:, None]).any(-1) | ~followed).all()


def test_a_plugin_gives_an_episode_its_own_level(desk: Path, tmp_path: Path) -> None:
    flags = {
        "plugins": PLUGIN,
        "repo": "local/desk",
        "root": desk,
        "new_root": tmp_path / "new",
        "episodes": "[0]",
        "cameras": "[front]",
        "variants": 1,
        "save_scenes": "true",
        "fit.steps": 4,
        "motion.levels": "[object,cell]",
        "motion.settings.cell.side_m": 0.03,
        "motion.frames_per_knot.cell": 4,
        "motion.gate": "false",
        "motion.register": "false",
    }
    assert augment.run([f"--{name}={value}" for name, value in flags.items()]) == 0
    (window,) = store.load(store.list_scenes(tmp_path / "new")[0][FRONT]).windows
    objects, cells = of_bases(window.levels)
    assert len(window.moving) > 0
    assert len(cells) > len(objects)
    assert (cells.parents >= 0).all()
    assert int(cells.knots.diff().max()) == 4
    apart = torch.cdist(cells.pivots, cells.pivots) + torch.eye(len(cells))
    same_part = cells.parents[:, None] == cells.parents
    assert (apart[same_part] < 1).any(), "several cells of one part"


def test_wrong_settings_of_a_plugin_are_refused(desk: Path) -> None:
    source = ["--repo", "local/desk", "--root", str(desk), "--plugins", str(PLUGIN)]
    for flag, value, message in (
        (
            "motion.settings.cell.side_m",
            "0",
            r"motion\.settings\.cell\.side_m is 0.0; expected a value from 0.001 to 10",
        ),
        ("motion.settings.cell.side", "1", r"motion\.settings\.cell: .*`side` are not valid"),
        ("motion.settings.cell", "1", r"settings"),
        (
            "motion.frames_per_knot.cells",
            "1",
            r"motion\.frames_per_knot\.cells is unknown; expected one of cell, .*grain",
        ),
        ("motion.levels", "[cell]", r"motion\.levels is \[cell\]; expected cell right after object"),
    ):
        with pytest.raises(ConfigError, match=message):
            augment.run([*source, f"--{flag}", value])
