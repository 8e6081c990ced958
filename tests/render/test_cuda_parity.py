"""The CUDA route renders what the reference and the CPU route render, with their gradients; skipped without a GPU.

gsplat computes with fast approximations (`-use_fast_math`), its sums of gradients are in no fixed order, and it gets
alpha as 1 - T: bounds are wider than those of the CPU route. From gsplat 1.6 on the cap of alpha is 0.99, not 0.999.
"""

import importlib
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.render import rasterize
from lerobot_msdyn.render.availability import cuda_problem

pytestmark = pytest.mark.gpu

PIXELS_OFF, CLOSE, GRADIENT = 2e-3, 1e-4, 2e-3


@pytest.fixture(autouse=True)
def _gpu() -> None:
    if cuda_problem():
        pytest.skip(cuda_problem())


@pytest.fixture
def workloads(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(Path(__file__).parent.parent.parent / "benchmarks")
    return importlib.import_module("gpu")


def assert_agrees(result, pixels_off=PIXELS_OFF, gradient=GRADIENT):
    assert result.off <= pixels_off
    assert max(result.gradients) <= gradient, result.gradients


@pytest.mark.parametrize("per_view", [(), (0,), (4,), (0, 1, 2, 3, 4)])
def test_batches_of_views_and_of_scenes(make_scene, compare_with_reference, per_view):
    scene = make_scene(views=3, per_view=per_view)
    assert_agrees(compare_with_reference(scene, "cuda", device="cuda", close_enough=CLOSE))


@pytest.mark.parametrize("channels", [1, 5, 16, 40])
def test_any_number_of_channels(make_scene, compare_with_reference, channels):
    assert_agrees(compare_with_reference(make_scene(channels=channels), "cuda", device="cuda", close_enough=CLOSE))


def test_saturated_pixels(make_scene, compare_with_reference):
    scene = make_scene(count=2000, radius=8.0, opacity=(0.97, 1.0))
    if find_spec("gsplat.cuda._constants") is None:  # gsplat up to 1.5
        assert_agrees(compare_with_reference(scene, "cuda", device="cuda", close_enough=CLOSE), pixels_off=2e-2)
    fast, exact = scene.render("cuda", device="cuda")[0], scene.render("reference", torch.float64)[0]
    assert (fast.features.cpu() - exact.features).abs().max() < 2e-2


def test_what_is_not_rendered_gets_no_gradient(make_scene):
    scene = make_scene(count=6)
    means, _, scales, opacities, _ = scene.gaussians
    means[0, 2] *= -1
    means[1] = torch.tensor([1e30, 0, 2.0])
    scales[2] = 1e30
    opacities[3] = 0.003
    raster, leaves = scene.render("cuda", device="cuda")
    (raster.alpha.sum() + raster.depth.sum()).backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves)
    assert all(leaf.grad[:4].abs().max() == 0 for leaf in leaves[:5])
    expected, _ = scene.render("reference", torch.float64)
    torch.testing.assert_close(raster.alpha.cpu().double(), expected.alpha, atol=1e-4, rtol=1e-3)


def test_an_empty_scene_and_bad_values(make_scene):
    raster, _ = make_scene(count=0, channels=5).render("cuda", device="cuda")
    assert raster.features.shape == (1, 45, 77, 5)
    scene = make_scene(count=4)
    scene.gaussians[0][2, 1] = float("nan")
    with pytest.raises(RenderError, match=r"means at index \[2, 1\] is nan"):
        scene.render("cuda", device="cuda")
    with pytest.raises(RenderError, match=r"expected torch\.float32 on cuda"):
        make_scene().render("cuda", torch.float64, device="cuda")


def test_auto_takes_gsplat_on_the_gpu(make_scene):
    scene = make_scene()
    tensors = [values.cuda() for values in (*scene.gaussians, scene.poses, scene.intrinsics)]
    arguments: Any = (*tensors, scene.width, scene.height)
    assert torch.equal(rasterize(*arguments).features, rasterize(*arguments, backend="cuda").features)


@pytest.mark.parametrize("name", ["W1", "W2", "W3"])
def test_workloads(workloads, name):
    rows = list(workloads.parity(workloads.Device("cuda"), [name]))
    assert [row["case"] for row in rows] == [f"{name} against CPU", f"{name} against reference"]
    assert all(row["pixels off"] <= PIXELS_OFF and row["gradients off, relative"] <= GRADIENT for row in rows), rows
