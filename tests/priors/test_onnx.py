"""Networks in files of ONNX: what reaches them, what comes back, and one line for everything that is wrong."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.errors import ConfigError, MsdynError, PriorError
from lerobot_msdyn.core.fields import problems
from lerobot_msdyn.core.observations import Priors, View
from lerobot_msdyn.priors import estimate_priors
from lerobot_msdyn.priors.depth.onnx_spec import FAMILIES, family_of, read_spec
from lerobot_msdyn.priors.estimate import check_named_providers

WIDTH, HEIGHT, FRAMES = 64, 48, 3


@pytest.fixture
def networks():
    """Skips where networks cannot be made or run."""
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    import tiny_onnx

    return tiny_onnx


def loaded(file: Path, **stated: Any):
    from lerobot_msdyn.priors.depth.onnx_network import OnnxNetwork

    return OnnxNetwork(file, read_spec(file, {"kind": "metric", **stated})[0], "cpu")


def ramp() -> torch.Tensor:
    """Red grows from left to right, green from top to bottom, blue is constant."""
    red = torch.linspace(0, 250, WIDTH).expand(HEIGHT, -1)
    green = torch.linspace(0, 250, HEIGHT)[:, None].expand(-1, WIDTH)
    image = torch.stack((red, green, torch.full_like(red, 60)), dim=-1)
    return image.round().to(torch.uint8).expand(FRAMES, -1, -1, -1).contiguous()


@pytest.mark.parametrize(
    ("stated", "weights", "expected"),
    [
        ({}, (0, 0, 1), 60 / 255),
        ({"white": 255}, (0, 0, 1), 60),
        ({"mean": [0, 0, 0.1], "std": [1, 1, 0.5]}, (0, 0, 1), (60 / 255 - 0.1) / 0.5),
        ({"channels": "bgr", "white": 255}, (1, 0, 0), 60),
        ({"white": 255, "mean": [0, 0, 50], "channels": "rgb"}, (0, 0, 1), 10),
    ],
)
def test_colours_arrive_as_stated(networks, tmp_path: Path, stated, weights, expected) -> None:
    network = loaded(networks.save_network(tmp_path / "net.onnx", weights=weights), **stated)
    values = network(ramp())
    assert values.shape == (FRAMES, HEIGHT, WIDTH)
    assert values.mean().item() == pytest.approx(expected, rel=1e-3)
    assert values.std().item() == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(
    "shape",
    [(1, 3, 12, 16), ("batch", 3, 12, 16), (1, 3, "height", "width"), (1, 1, 3, 12, 16), ("b", "n", 3, "h", "w")],
)
def test_pictures_keep_their_place(networks, tmp_path: Path, shape) -> None:
    """Also where the network takes another shape, and where it leaves its size open."""
    file = networks.save_network(tmp_path / "net.onnx", shape=shape)
    values = loaded(file, white=255, size=[12, 16])(ramp())
    torch.testing.assert_close(values, ramp()[..., 0].float(), atol=6.0, rtol=0)


@pytest.mark.parametrize("shape", [(1, 3, 32, 32), (1, 3, 12, 64)])
def test_a_padded_picture_keeps_its_shape_and_its_place(networks, tmp_path: Path, shape) -> None:
    file = networks.save_network(tmp_path / "net.onnx", shape=shape)
    values = loaded(file, white=255, fit="pad")(ramp())
    torch.testing.assert_close(values[:, 2:-2, 4:-4], ramp()[:, 2:-2, 4:-4, 0].float(), atol=10.0, rtol=0)


def test_metres_of_another_focal_length_are_brought_to_this_camera(networks, tmp_path: Path) -> None:
    file = networks.save_network(tmp_path / "net.onnx", weights=(0, 0, 1))
    intrinsics = intrinsics_from_fov(WIDTH, HEIGHT, 60.0)
    values = loaded(file, white=255, focal_px=100)(ramp(), intrinsics)
    focal_there = float(intrinsics[0, 0]) * 16 / WIDTH
    assert values.mean().item() == pytest.approx(60 * focal_there / 100, rel=1e-3)


def test_other_types_of_input(networks, tmp_path: Path) -> None:
    from onnx import TensorProto

    for kind in (TensorProto.UINT8, TensorProto.FLOAT16):
        file = networks.save_network(tmp_path / f"net{kind}.onnx", kind=kind, weights=(0, 0, 1))
        assert loaded(file, white=255)(ramp()).mean().item() == pytest.approx(60, rel=1e-2)
    file = networks.save_network(tmp_path / "net.onnx", kind=TensorProto.INT32)
    with pytest.raises(PriorError, match=r"takes tensor\(int32\); expected one of tensor\(float\)"):
        loaded(file)


def test_depth_is_found_among_outputs(networks, tmp_path: Path) -> None:
    file = networks.save_network(tmp_path / "net.onnx", outputs=("confidence", "predicted_depth"))
    assert loaded(file)(ramp()).isfinite().all()
    file = networks.save_network(tmp_path / "two.onnx", outputs=("a", "b"))
    with pytest.raises(PriorError, match="gives a, b; which is depth"):
        loaded(file)
    assert loaded(file, output="b")(ramp()).isfinite().all()
    with pytest.raises(PriorError, match="gives a, b; output is 'c'"):
        loaded(file, output="c")


@pytest.mark.parametrize(
    ("shape", "stated", "message"),
    [
        ((1, 3, 12), {}, r"input of shape \[1, 3, 12\]; expected one picture, \[1, 3, height, width\]"),
        ((1, 4, 12, 16), {}, r"input of shape \[1, 4, 12, 16\]; expected"),
        ((2, 3, 12, 16), {}, r"input of shape \[2, 3, 12, 16\]; expected one picture"),
        ((1, 3, "h", "w"), {}, "leaves the height of its input open; state size"),
        ((1, 3, 12, 16), {"size": [12, 20]}, "takes a width of 16 px, but size says 20"),
    ],
)
def test_inputs_that_are_no_picture_are_refused(networks, tmp_path: Path, shape, stated, message) -> None:
    file = tmp_path / "net.onnx"
    if shape in ((1, 3, 12), (1, 4, 12, 16)):
        networks.save_any_input(file, shape)
    else:
        networks.save_network(file, shape=shape)
    with pytest.raises(PriorError, match=message) as caught:
        loaded(file, **stated)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_network_is_named(networks, tmp_path: Path) -> None:
    file = tmp_path / "net.onnx"
    for content in (b"", b"no network", b"\x08\x09" * 40):
        file.write_bytes(content)
        with pytest.raises(PriorError, match=r"net\.onnx is no network that onnxruntime can load") as caught:
            loaded(file)
        assert "\n" not in str(caught.value)


def test_what_is_stated_goes_before_the_name(tmp_path: Path) -> None:
    file = tmp_path / "depth_anything_v2_vits.onnx"
    spec, told = read_spec(file, {})
    assert (spec.kind, spec.mean[0], told) == ("affine_disparity", 0.485, "as depthanythingv2 networks")
    file.with_suffix(".yaml").write_text("kind: scale\nsize: [392, 518]\nlicence: MIT\n")
    spec, told = read_spec(file, {})
    assert (spec.kind, spec.mean[0], spec.size, spec.licence) == ("scale", 0.485, [392, 518], "MIT")
    spec, told = read_spec(file, {"kind": "metric", "white": 255})
    assert (spec.kind, spec.white, spec.size) == ("metric", 255, [392, 518])
    assert told == f"as depthanythingv2 networks and by {file.stem}.yaml and by priors.onnx"


@pytest.mark.parametrize(
    ("name", "family"),
    [
        ("depth_anything_v2_vits_518.onnx", "depthanythingv2"),
        ("Depth-Anything-V2-Metric-Indoor-Small.onnx", "depthanythingv2metric"),
        ("depth_anything_v2_metric_hypersim_vits.onnx", "depthanythingv2metric"),
        ("da3-small.onnx", "depthanythingv3"),
        ("depth-anything-3-base.onnx", "depthanythingv3"),
        ("midas_v21_small_256.onnx", "midas"),
        ("metric3d-vit-small.onnx", "metric3d"),
        ("tcmonodepth_tcsmallnet_192x320.onnx", "tcmonodepth"),
        ("fastdepth_7.onnx", "fastdepth"),
        ("model.onnx", ""),
    ],
)
def test_a_family_is_told_by_the_name(name: str, family: str) -> None:
    assert family_of(Path(name)) == (family, FAMILIES.get(family, {}))


def test_every_family_is_a_valid_spec(tmp_path: Path) -> None:
    for name in FAMILIES:
        assert read_spec(tmp_path / f"{name}.onnx", {})[0].kind


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        (None, r"what its numbers mean cannot be told from its name; state it in net\.yaml beside it"),
        ("kind: [", r"net\.yaml cannot be read as YAML"),
        ("- 1", r"net\.yaml holds list; expected a mapping"),
        ("kind: metric\nmeen: [0, 0, 0]", r"net\.yaml: unknown key 'meen'; did you mean 'mean'"),
        ("kind: inverse", "inverse"),
        ("kind: metric\nmean: [0, 0]", r"mean is \[0.0, 0.0\]; expected 3 numbers"),
        ("kind: metric\nstd: [1, 0, 1]", "std has a 0"),
        ("kind: metric\nsize: [12]", r"size is \[12\]; expected \[height, width\]"),
        ("kind: metric\nwhite: much", "white"),
        ("kind: metric\nwhite: 0", "white is 0.0; expected a value from"),
        ("kind: scale\nfocal_px: 1000", "focal_px is 1000, but kind is scale"),
        ("!!python/object/apply:os.system ['true']", "cannot be read as YAML"),
    ],
)
def test_a_wrong_yaml_is_named_in_one_line(tmp_path: Path, yaml: str | None, message: str) -> None:
    file = tmp_path / "net.onnx"
    if yaml is not None:
        file.with_suffix(".yaml").write_text(yaml)
    with pytest.raises(PriorError, match=message) as caught:
        read_spec(file, {})
    assert "\n" not in str(caught.value)


def test_unknown_settings_are_named_too(tmp_path: Path) -> None:
    with pytest.raises(PriorError, match=r"priors\.onnx: unknown key 'knd'; did you mean 'kind'"):
        read_spec(tmp_path / "net.onnx", {"knd": "metric"})


@pytest.fixture
def view() -> View:
    """A ramp with recorded depth: one over what a network makes of red."""
    rgb = ramp()
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    return View(rgb, camera, 1 / (0.5 + rgb[..., 0] / 255), (0.01, 10.0))


def estimate(view: View, depth: str, **settings: Any) -> Priors:
    config = PriorsConfig(depth=depth, masks="change", tracks="flow", onnx=settings)
    return estimate_priors(view, config, CameraConfig(), episode=0, key="front")


def test_the_provider_brings_a_network_to_metres(networks, tmp_path: Path, view: View) -> None:
    file = networks.save_network(tmp_path / "net.onnx", shape=(1, 3, HEIGHT, WIDTH))
    priors = estimate(view, f"onnx:{file}", kind="affine_disparity", licence="MIT")
    assert view.depth is not None
    torch.testing.assert_close(priors.depth, view.depth, rtol=0.02, atol=0)
    assert priors.metric
    entry = priors.provenance["depth"]
    assert (entry["provider"], entry["model"], entry["licence"]) == ("onnx", "net.onnx", "MIT")
    assert entry["why"] == "asked for; read by priors.onnx; scaled and shifted to recorded"


def test_what_is_kept_depends_on_the_file_and_on_what_is_stated(networks, tmp_path: Path, view: View) -> None:
    file = networks.save_network(tmp_path / "net.onnx", shape=(1, 3, HEIGHT, WIDTH))
    bare = replace(view, depth=None)
    first = estimate(bare, f"onnx:{file}", kind="metric").depth
    assert estimate(bare, f"onnx:{file}", kind="metric", white=510.0).depth.mean() > 1.5 * first.mean()
    networks.save_network(file, shape=(1, 3, HEIGHT, WIDTH), weights=(3, 0, 0))
    assert estimate(bare, f"onnx:{file}", kind="metric").depth.mean() > 2 * first.mean()


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        ("onnx:/absent/net.onnx", r"priors.depth is 'onnx:/absent/net.onnx', but there is no file /absent/net.onnx"),
        ("onnx", r"priors.depth is 'onnx'; expected onnx:FILE.onnx"),
        ("onnx:", r"priors.depth is 'onnx:'; expected onnx:FILE.onnx"),
        ("plane:x", r"priors.depth is 'plane:x'; expected plane alone"),
    ],
)
def test_a_wrong_choice_is_named_in_one_line(view: View, depth: str, message: str) -> None:
    if depth.startswith("onnx:/"):
        pytest.importorskip("onnxruntime")
    with pytest.raises(MsdynError, match=message) as caught:
        estimate(view, depth)
    assert "\n" not in str(caught.value)
    with pytest.raises(MsdynError, match=message):
        check_named_providers(PriorsConfig(depth=depth), CameraConfig(), "cpu")


def test_what_is_wrong_with_a_network_is_known_before_any_video_is_read(networks, tmp_path: Path) -> None:
    file = networks.save_network(tmp_path / "net.onnx", shape=(1, 3, HEIGHT, WIDTH))
    config = PriorsConfig(depth=f"onnx:{file}", onnx={"kind": "metric"})
    check_named_providers(config, CameraConfig(), "cpu")
    with pytest.raises(PriorError, match="unknown key 'knd'"):
        check_named_providers(replace(config, onnx={"knd": "metric"}), CameraConfig(), "cpu")
    file.write_bytes(b"no network")
    with pytest.raises(PriorError, match="is no network that onnxruntime can load"):
        check_named_providers(config, CameraConfig(), "cpu")


def test_only_names_of_the_registry_take_a_parameter() -> None:
    assert problems(PriorsConfig(depth="onnx:net.onnx")) == []
    assert re.match(r"depth is 'onxx:net.onnx'; expected auto, ", problems(PriorsConfig(depth="onxx:net.onnx"))[0])


def test_without_onnxruntime_the_command_that_installs_it_is_named(monkeypatch, tmp_path: Path, view: View) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(PriorError, match=r"needs onnxruntime; install it with: pip install 'lerobot_msdyn\[onnx\]'"):
        estimate(view, f"onnx:{tmp_path / 'net.onnx'}")


@pytest.mark.parametrize("name", ["tcmonodepth_tcsmallnet_192x320.onnx", "fastdepth_7.onnx"])
def test_real_networks_tell_near_from_far(shared_data: Path, name: str) -> None:
    """Of a desk: its lower edge is nearer than the wall above it."""
    from lerobot_msdyn.dataset.read import open_source, read_episode
    from lerobot_msdyn.priors.depth.onnx_network import OnnxNetwork

    pytest.importorskip("onnxruntime")
    key = "observation.images.front"
    scene = shared_data / "sim" / "pick_place"
    source = open_source("local/pick_place", scene / "dataset")
    view = read_episode(source, 0, [key], CameraConfig()).views[key].select(slice(0, 2))
    file = shared_data / "models" / name
    spec, _ = read_spec(file, {})
    values = OnnxNetwork(file, spec, "cpu")(view.rgb)
    depth = 1 / values.clamp(min=1e-6) if spec.kind == "affine_disparity" else values
    assert depth[:, 200:].median() < 0.8 * depth[:, :60].median()
    truth = np.moveaxis(np.load(scene / "gt" / "train.npz")["depth"][..., :2], -1, 0).astype(np.float32)
    one, other = (np.argsort(np.argsort(each[0, ::7, ::7].ravel())) for each in (depth.numpy(), truth))
    assert np.corrcoef(one, other)[0, 1] > 0.7


def test_a_missing_provider_is_still_a_config_error(view: View) -> None:
    with pytest.raises(ConfigError, match="no depth provider 'onxx'"):
        estimate(view, "onxx:net.onnx")
