"""The ablation: warped pictures, learned motion, figures that are kept, and what is made of them."""

import importlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cameras import CameraTrack, intrinsics_from_fov, static_camera

pytestmark = pytest.mark.slow

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
TINY = ["--steps", "4", "--width", "64", "--frames", "12", "--every", "6", "--kinds", "push", "--seeds", "0"]


@pytest.fixture
def ablation(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("ablation")


@pytest.fixture
def rivals(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("ablation_rivals")


@pytest.fixture
def report(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("ablation_report")


def camera(x_m: float = 0.0) -> CameraTrack:
    pose = torch.eye(4)
    pose[0, 3] = x_m
    return static_camera(intrinsics_from_fov(32, 24, 60.0), 1, 32, 24, pose)


def noise(seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, (24, 32, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


def test_a_picture_warped_to_its_own_camera_is_itself(rivals: ModuleType) -> None:
    colours, weight = rivals.splat(noise(), torch.full((24, 32), 0.7), camera(), camera())
    np.testing.assert_allclose(colours, noise().numpy(), atol=0.1)
    np.testing.assert_allclose(weight, 1, atol=1e-3)


def test_a_wall_shifts_by_its_disparity_and_leaves_a_hole(rivals: ModuleType) -> None:
    focal = float(camera().intrinsics[0, 0, 0])
    colours, weight = rivals.splat(noise(), torch.full((24, 32), 0.7), camera(), camera(3 * 0.7 / focal))
    np.testing.assert_allclose(colours[:, :29], noise().numpy()[:, 3:], atol=0.2)
    assert (weight[:, 29:] < 0.05).all()


def test_what_is_nearer_hides_what_is_behind_and_unknown_depth_shows_nothing(rivals: ModuleType) -> None:
    depth = torch.full((24, 32), 1.0)
    depth[:, 16:] = 0.5
    depth[0] = 0
    focal = float(camera().intrinsics[0, 0, 0])
    colours, weight = rivals.splat(noise(), depth, camera(), camera(4 / focal))
    np.testing.assert_allclose(colours[1:, 8:12], noise().numpy()[1:, 16:20], atol=0.2)
    assert (weight[0] == 0).all()


def test_cracks_are_closed_and_holes_are_not(rivals: ModuleType) -> None:
    colours, weight = np.full((9, 9, 3), 50, np.float32), np.ones((9, 9), np.float32)
    weight[:, 2], weight[4:, 5:] = 0, 0
    colours, weight = rivals.closed(colours, weight)
    assert (weight[1:-1, 2] == 1).all()
    assert (colours[1:-1, 2] == 50).all()
    assert (weight[7:, 7:] == 0).all()


def test_motion_that_is_learned_changes_in_the_fit_and_is_fixed_afterwards(ablation: ModuleType) -> None:
    settings = ablation.Settings(steps=4, width=64, frames=12, every=6)
    prepared = ablation.prepare(ablation.synthetic_case("push", 0, 12, 64, 6, true_priors=True))
    for name, tensor in (("L1-L3, learned", "displacements"), ("field, learned afresh", "last")):
        row = next(row for row in ablation.ROWS if row.name == name)
        scenes = [
            ablation.reconstructed(prepared, one, ablation.recipe_of(one, settings, 0)).windows[0].scene
            for one in (replace(row, deformation="", fit={}), row)
        ]
        fixed, learned = (getattr(scene.levels[0], tensor) for scene in scenes)
        assert not learned.requires_grad
        assert not torch.equal(fixed, learned)


def test_the_rows_of_the_paper_change_one_thing_each_of_its_recipe(ablation: ModuleType) -> None:
    settings = ablation.Settings(steps=7, width=64)
    recipes = {row.name: asdict(ablation.recipe_of(row, settings, 1)) for row in ablation.PAPER_ROWS}
    whole = recipes["paper: L1-L3"]
    assert whole["fit"]["learn"] == {"bases": True, "weights": True, "poses": True, "begin": 0, "sure_px": 0}
    assert whole["fit"]["density"]["enabled"]
    assert (whole["fit"]["steps"], whole["fit"]["max_width"], whole["seed"]) == (7, 64, 1)
    changed = {
        name: [
            (part, field)
            for part in ("scene", "motion", "fit")
            for field, value in recipe[part].items()
            if value != whole[part][field]
        ]
        for name, recipe in recipes.items()
    }
    assert changed.pop("paper: L1-L3") == []
    assert changed.pop("paper: L1+L2+") == [("motion", "levels"), ("motion", "primitives")]
    assert all(len(fields) == 1 for fields in changed.values())


def test_true_priors_are_those_of_the_synthetic_scene(ablation: ModuleType) -> None:
    own, true = (
        ablation.prepare(ablation.synthetic_case("push", 0, 12, 64, 6, true_priors=given)) for given in (False, True)
    )
    assert own.case.truth is None
    assert true.priors.instances is true.case.truth.instances
    assert set(true.priors.tracks.instance.unique().tolist()) == {1, 2}
    assert len(true.priors.tracks) > len(own.priors.tracks)


def test_a_run_goes_on_where_it_was_stopped(ablation: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    first = [*TINY, "--json", str(path), "--rows", "source picture"]
    ablation.main(first)
    before = json.loads(path.read_text())
    assert before["settings"] == asdict(ablation.Settings(4, 64, 12, 6))
    before["figures"][0]["cpu_s"] = -1.0  # a mark
    path.write_text(json.dumps(before))
    ablation.main([*first[:-1], "source picture;warp + background;the method with overlay"])
    after = json.loads(path.read_text())["figures"]
    assert after[0]["cpu_s"] == -1.0
    assert [one["row"] for one in after] == ["source picture", "warp + background", "the method with overlay"]
    assert all(5 < one[name] < 60 for one in after for name in ("all", "moving", "disoccluded"))
    ablation.main([*first, "--true_priors"])
    assert [one["priors"] for one in json.loads(path.read_text())["figures"]] == ["own", "own", "own", "true"]
    with pytest.raises(SystemExit, match="choose another --json"):
        ablation.main([*first, "--steps", "5"])


def test_simulated_episodes_are_read_at_the_frames_that_are_used(ablation: ModuleType, shared_data: Path) -> None:
    case = ablation.simulated_case(shared_data / "sim" / "rigid_push", 0, 80, 2, 3)
    assert case.view.rgb.shape == (60, 60, 80, 3)
    one = case.heldout[0]
    assert one.frames.tolist() == [0, 15, 30, 45]
    assert one.rgb.shape == (4, 60, 80, 3)
    assert 0.01 < one.moving.mean() < 0.5
    assert set(np.unique(one.seen)) == {0, 1, 2}


def figures() -> list[dict]:
    return [
        {
            "scene": scene,
            "seed": seed,
            "priors": "own",
            "row": row,
            "all": base + seed,
            "moving": base - seed,
            "disoccluded": base,
        }
        for row, base in (("L1", 20.0), ("L1-L3", 22.0))
        for scene, seed in (("push", 0), ("push", 1), ("push", 2), ("real <arm>", 0))
    ]


def test_the_table_gives_medians_and_their_spread(report: ModuleType) -> None:
    lines = report.overview_table(figures(), ["real <arm>"]).splitlines()
    assert lines[2] == (
        "| L1 | 21.00 (20.00 to 22.00) | 19.00 (18.00 to 20.00) | 20.00 (20.00 to 20.00) | 20.00 | 20.00 | 20.00 |"
    )
    true = {"scene": "push", "seed": 0, "priors": "true", "row": "L1-L3", "moving": 30.0}
    assert report.scene_table([*figures(), true]).splitlines()[3] == "| L1-L3 | 21.00 | 22.00 | 30.00 |"


def test_a_row_that_is_not_finished_stays_empty(report: ModuleType) -> None:
    table = report.overview_table(figures()[:-1], ["real <arm>"])
    assert table.splitlines()[3].endswith("|  |  |  |")


def test_simulated_scenes_alone_have_no_columns_of_others(report: ModuleType) -> None:
    simulated = [one for one in figures() if one["scene"] == "real <arm>"]
    lines = report.overview_table(simulated, ["real <arm>"]).splitlines()
    assert lines[0] == "| | simulated: all | simulated: moving | simulated: disoccluded |"
    assert lines[2] == "| L1 | 20.00 | 20.00 | 20.00 |"


def test_the_plot_has_a_dot_for_every_case(report: ModuleType) -> None:
    picture = ElementTree.fromstring(report.plot(figures(), ["real <arm>"]))
    circles = picture.findall("{http://www.w3.org/2000/svg}circle")
    assert len(circles) == 8 + 2  # and two of the key
