"""The benchmark of motion: its short run, and what its figures rest on."""

import dataclasses
import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.motion.model.compose import compose
from lerobot_msdyn.synthetic import make_scene

pytestmark = pytest.mark.slow

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module, which sets the number of threads."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    threads = torch.get_num_threads()
    yield importlib.import_module("motion")
    torch.set_num_threads(threads)


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("simulated")


def test_the_short_run_writes_its_figures(benchmark: ModuleType, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    benchmark.main(["--quick", "--gate", "on", "--json", str(report)])
    content = json.loads(report.read_text())
    assert all(row["sparse_ms"] > 0 and row["dense_ratio"] > 0 for row in content["time"])
    assert [row["scale"] for row in content["growth"]].count(1) == 5
    assert {(row["scene"], *row["levels"]) for row in content["errors"]} == {
        (scene, *levels)
        for scene in ("rigid", "weak", "deformable")
        for levels in (("object",), ("object", "primitive"))
    }
    assert all(0 < row["error_mm"] < 20 and row["gate"] for row in content["errors"])


def test_all_routes_give_the_same(benchmark: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    sparse = compose(*benchmark.make_load(40, 3).arguments)
    dense = benchmark.make_load(40, 3, dense=True)
    for by_matrix in (False, True):
        if by_matrix:
            monkeypatch.setattr(benchmark.bases, "blend", benchmark.blend_by_matrix)
        for one, other in zip(sparse, compose(*dense.arguments), strict=True):
            torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)
        dense.forward_backward()


def test_points_keep_their_place_on_a_mesh_that_moves(simulated: ModuleType) -> None:
    grid = torch.stack(torch.meshgrid(torch.arange(4.0), torch.arange(4.0), indexing="ij"), -1).reshape(-1, 2)
    vertices = 0.01 * torch.cat((grid, torch.zeros(16, 1)), dim=1)
    corner = torch.tensor([4 * row + column for row in range(3) for column in range(3)])[:, None]
    faces = torch.cat((corner + torch.tensor([0, 4, 1]), corner + torch.tensor([5, 1, 4])))
    rotation = axis_angle_to_matrix(torch.tensor([0.3, -0.5, 0.8]))
    motion = se3(rotation, torch.tensor([0.1, 0.2, 0.3]))
    moved = vertices @ rotation.T + motion[:3, 3]
    points = torch.tensor([[0.012, 0.007, 0.001], [0.025, 0.021, -0.002]])
    carried = simulated.carried_by_mesh(points, simulated.Cloth(200, torch.stack((vertices, moved)), faces), 0)
    torch.testing.assert_close(carried[:, 0], points)
    torch.testing.assert_close(carried[:, 1], points @ rotation.T + motion[:3, 3])


def test_true_points_on_the_cloth_are_carried_as_the_truth_says(simulated: ModuleType, shared_data: Path) -> None:
    episode = simulated.read_simulated(shared_data / "sim" / "deformable")
    for frame in episode.query.unique().tolist():
        rows = (episode.query == frame) & (episode.body == episode.cloth.body)
        carried = simulated.carried_by_mesh(episode.xyz[rows, frame], episode.cloth, frame)
        error = (carried - episode.xyz[rows]).norm(dim=-1)
        assert error.mean() < 1e-4
        assert error.max() < 5e-3


def test_the_figures_of_the_gates_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    gate = importlib.import_module("gate")
    row = gate.Row("push", "none", "az", 20.0, 21.0, 0.9, 0.91, 0.5)
    rows = [dataclasses.replace(row, score_db=20.0 + i, true_db=15.0 + i) for i in range(10)]
    found = gate.summary(rows)
    assert (found["cases"], found["spearman"], found["coverage_error_points"]) == (10, 1.0, 1.0)
    assert (found["bad_views"], found["caught_share"], found["bias_db"]) == (5, 0.4, 5.0)


def test_corruptions_are_what_they_are_called(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    corruptions = importlib.import_module("corruptions")
    rng = np.random.default_rng(0)
    depth = np.full((6, 24, 32), 0.7, np.float32)
    wrong = np.abs(np.log(corruptions.wrong_depth(depth, rng) / depth))
    assert 0.01 < wrong.mean() < 0.15
    masks = np.zeros((40, 24, 32), np.uint8)
    masks[:, 10:14, 10:14] = 3
    broken = corruptions.broken_masks(masks, rng)
    assert 0.2 < (broken.sum((1, 2)) == 0).mean() < 0.6
    assert set(np.unique(broken)) == {0, 3}
    scene = make_scene("push", 0, 12, 64, 48)
    seen = scene.render(scene.camera)
    view, recipe = View(seen.rgb, scene.camera, seen.depth), Recipe()
    priors = corruptions.clean_priors(view, recipe)
    for name in corruptions.CORRUPTIONS:
        case = corruptions.corrupted(view, recipe, name, priors, tmp_path)
        assert case.recipe.priors.masks.endswith(f"{name}.npz")
        assert case.recipe.priors.depth == ("auto" if name != "wrong_depth" else case.recipe.priors.masks)
        assert (case.recipe.fit.steps == 1) == (name == "too_few_steps")
    assert recipe == Recipe()


def test_the_gpu_benchmark_runs_on_the_cpu(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    gpu = importlib.import_module("gpu")
    sizes = ["--workloads", "W3", "--parity", "W3", "--frames", "12", "--width", "96", "--height", "72"]
    small = ["--device", "cpu", "--recipe", "quick", "--steps", "4", "--episodes", "2"]
    gpu.main([*small, *sizes, "--json", str(tmp_path / "gpu.json")])
    rows = json.loads((tmp_path / "gpu.json").read_text())
    assert {row["part"] for row in rows} == set(gpu.PARTS)
    assert all(row["pixels off"] < 1e-3 for row in rows if row["part"] == "parity")
    said = capsys.readouterr().out
    assert "augment ended with" not in said
    assert "frames per s, rendered alone" in said


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("pipeline")


def test_the_gate_of_the_pipeline_judges_how_figures_grow(pipeline: ModuleType) -> None:
    baseline = json.loads(pipeline.BASELINE.read_text())
    assert [row["name"] for row in baseline] == [case.name for case in pipeline.SMALL]
    assert pipeline.violations(baseline, baseline) == []
    slower_machine = [
        row | {name: 3 * value for name, value in row.items() if name.startswith("cpu ")} for row in baseline
    ]
    assert pipeline.violations(slower_machine, baseline) == []
    worse = [dict(row) for row in baseline]
    worse[1]["cpu all"] *= 1.5
    worse[2]["peak MB"] *= 1.5
    found = pipeline.violations(worse, baseline)
    assert len(found) == 2
    assert found[0].startswith("frames x 2: cpu all is ")
    assert found[1].startswith("size x 2: peak MB is ")
    with pytest.raises(SystemExit, match="other cases"):
        pipeline.violations([row | {"steps": 41} for row in baseline], baseline)


def test_time_is_added_up_by_stage(pipeline: ModuleType) -> None:
    seconds = dict.fromkeys(("sum", "cpu sum"), 0.0)
    call = pipeline.timed(sum, "sum", seconds)
    assert [call([1, 2]), call(range(100_000))] == [3, 4999950000]
    assert seconds["cpu sum"] > 0
    assert seconds["sum"] > 0
