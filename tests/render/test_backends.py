"""Which backend renders, and what `rasterize` refuses."""

import logging
import math
import os
import subprocess
import sys
from typing import Any

import pytest
import torch

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.render import backends, rasterize
from lerobot_msdyn.render.validation import check_shapes

NAMES = ("means", "quats", "scales", "opacities", "features")


def arguments(scene, **changes: Any) -> dict[str, Any]:
    values: dict[str, Any] = dict(zip(NAMES, scene.gaussians, strict=True))
    values |= {"camera_from_world": scene.poses, "intrinsics": scene.intrinsics}
    values |= {"width": scene.width, "height": scene.height}
    return values | changes


def test_auto_renders_float32_on_the_cpu_with_numba(make_scene):
    scene = make_scene()
    assert torch.equal(rasterize(**arguments(scene)).features, scene.render("cpu")[0].features)


@pytest.mark.parametrize("channels", [3, 17])
def test_auto_leaves_float64_and_many_channels_to_the_reference(make_scene, channels):
    scene = make_scene(channels=channels)
    dtype = torch.float64 if channels == 3 else torch.float32
    values: dict[str, Any] = {key: v.to(dtype) if torch.is_tensor(v) else v for key, v in arguments(scene).items()}
    raster = rasterize(**values)
    assert raster.features.dtype == dtype
    assert torch.equal(raster.features, rasterize(**values, backend="reference").features)


def test_auto_falls_back_with_one_warning_where_numba_cannot_run(make_scene, monkeypatch, caplog):
    reference = backends.rasterize_reference
    monkeypatch.setattr(backends, "_load", lambda name: (None, "no numba here") if name == "cpu" else (reference, ""))
    backends._warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        rasterize(**arguments(make_scene()))
        rasterize(**arguments(make_scene()))
    assert [record.getMessage() for record in caplog.records if "no numba here" in record.getMessage()] == [
        "rasterizing in plain torch, 10 to 25 times slower: backend 'cpu' cannot be used (no numba here)"
    ]
    with pytest.raises(RenderError, match="backend 'cpu' cannot be used: no numba here"):
        rasterize(**arguments(make_scene()), backend="cpu")
    backends._warn_once.cache_clear()


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("means", (7, 1), math.nan, r"means at index \[7, 1\] is nan; expected a finite number"),
        ("quats", (3,), 0.0, r"the length of quats at index \[3\] is 0"),
        ("scales", (2, 2), -0.1, r"scales at index \[2, 2\] is -0.1"),
        ("scales", (2, 2), math.inf, r"scales at index \[2, 2\] is inf"),
        ("opacities", (4,), 1.5, r"opacities at index \[4\] is 1.5; expected 0..1"),
        ("opacities", (4,), math.nan, r"opacities at index \[4\] is nan"),
        ("features", (9, 0), math.inf, r"features at index \[9, 0\] is inf"),
        ("camera_from_world", (0, 1, 3), math.nan, r"camera_from_world at index \[0, 1, 3\] is nan"),
        ("intrinsics", (0, 1, 1), -5.0, r"intrinsics at index \[0, 1, 1\] is -5; expected a positive focal"),
    ],
)
def test_bad_values_are_named_with_their_first_index(make_scene, backend, name, index, value, message):
    values = arguments(make_scene(), backend=backend)
    values[name] = values[name].clone()
    values[name][index] = value
    with pytest.raises(RenderError, match=message):
        rasterize(**values)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("quats", (10, 3), r"quats has shape \[10, 3\]; expected \[10, 4\], or \[2, 10, 4\] \(one set per view\)"),
        ("means", (3, 10, 3), r"means has shape \[3, 10, 3\]; expected \[10, 3\], or \[2, 10, 3\]"),
        ("opacities", (10, 1), r"opacities has shape \[10, 1\]; expected \[10\], or \[2, 10\]"),
        ("features", (9, 5), r"features has shape \[9, 5\]; expected \[10, c\], or \[2, 10, c\]"),
        ("intrinsics", (3, 3), r"intrinsics has shape \[3, 3\]; expected \[2, 3, 3\]"),
    ],
)
def test_bad_shapes_are_refused(name, shape, message):
    shapes = {"means": (10, 3), "quats": (10, 4), "scales": (10, 3), "opacities": (10,), "features": (10, 5)}
    cameras = {"camera_from_world": (2, 4, 4), "intrinsics": (2, 3, 3)}
    (cameras if name in cameras else shapes)[name] = shape
    with pytest.raises(RenderError, match=message):
        check_shapes(
            {key: torch.zeros(value) for key, value in shapes.items()},
            {key: torch.zeros(value) for key, value in cameras.items()},
            8,
            8,
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "image size is 0 x 45 px"),
        ({"near": 0.0}, "near is 0.0 m; expected a positive distance"),
        ({"backend": "metal"}, "backend is 'metal'; expected one of auto, reference, cpu, cuda"),
        (
            {"scales": torch.ones(300, 3, dtype=torch.float64)},
            "scales is torch.float64 on cpu, means are torch.float32",
        ),
    ],
)
def test_bad_options_are_refused(make_scene, change, message):
    with pytest.raises(RenderError, match=message):
        rasterize(**arguments(make_scene(), **change))


def test_the_cpu_backend_takes_float32_and_16_channels(make_scene):
    with pytest.raises(RenderError, match=r"got torch.float64 on cpu; expected torch.float32 on cpu"):
        make_scene().render("cpu", torch.float64)
    with pytest.raises(RenderError, match="got 17 feature channels; expected at most 16"):
        make_scene(channels=17).render("cpu")


_PROBE = """
import logging, sys, time
logging.basicConfig(level=logging.INFO, format="%(name)s %(message)s")
from lerobot_msdyn.render import warmup
from lerobot_msdyn.render.backends import _load
assert "numba" not in sys.modules, "importing the package imports numba"
warmup.warm_up([3])
from lerobot_msdyn.render.cpu.simd import LANES
print(LANES)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.uname().machine != "x86_64", reason="names an x86 processor")
def test_a_processor_with_avx2_only_and_a_warm_second_start(tmp_path):
    environment = {**os.environ, "NUMBA_CPU_NAME": "haswell", "NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [
        subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True, text=True, timeout=300)
        for _ in range(2)
    ]
    assert [(run.returncode, run.stdout) for run in runs] == [(0, "8\n")] * 2, runs[0].stderr
    assert runs[0].stderr.count("compiling the CPU rasterizer") == 1
    assert "compiling" not in runs[1].stderr
