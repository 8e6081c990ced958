"""Every figure of the CUDA route, in one run: times, memory, time outside kernels, and parity with the CPU route.

    python benchmarks/gpu.py [--json FILE]

Needs a CUDA device, gsplat, and a compiler the first time. Parts, in order:

rasterizer   ms per render and per render with gradients, 8 channels; peak memory; the share of the time in which no
             kernel runs
parity       pictures and gradients against the CPU route and against the reference in float64
psnr         the same short video fitted on both routes: held-out PSNR, which should differ by less than 0.2 dB
episode      a synthetic episode by `augment`, two variants, whole, from a cold start and again; the seconds of each
             step of its reconstruction; its fit (ms per step, share outside kernels), the frames per second of
             rendering alone and with holes filled, peak memory
several      as many short episodes, one after the other and at the same time

`--device cpu` with small sizes tries the script itself where there is no GPU; parity is then of the CPU route.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command does, before torch is loaded

import torch
from rasterizer import Workload, make_workload

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core.cli import parse_config
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.read import open_source, read_episode
from lerobot_msdyn.reconstruction.account import decibels
from lerobot_msdyn.reconstruction.reconstruct import STEPS, Draft, reconstruct, with_steps
from lerobot_msdyn.render.devices import chosen_device
from lerobot_msdyn.scene.rendering import render_frames
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.views.new_cameras import new_cameras
from lerobot_msdyn.views.pictures import for_many_views, new_pictures

KEY = "observation.images.front"
ALL_KEPT = {  # views are judged, but none is sampled again or dropped
    "max_unseen": 1,
    "gate.min_expected_db": 0,
    "gate.max_track_px": 1e9,
    "gate.max_flicker_ratio": 1e9,
    "gate.min_sharpness_ratio": 0,
}
CHANNELS = 8  # features and depth
RUNS = 20
THRESHOLD = 2e-5  # pixels that differ by more are those at which rounding decides; they get no gradient
PARTS = ("rasterizer", "parity", "psnr", "episode", "several")


class Device:
    """What is measured, and how it is waited for."""

    def __init__(self, name: str) -> None:
        self.device = chosen_device("cuda" if name == "cuda" else "cpu")
        self.backend, self.is_cuda = self.device.type, self.device.type == "cuda"

    def wait(self) -> None:
        if self.is_cuda:
            torch.cuda.synchronize()

    def ms(self, call: Callable[[], object], runs: int = RUNS) -> float:
        """Median wall time of a call, until the device is done."""
        times = []
        for number in range(runs + 3):
            self.wait()
            start = time.perf_counter()
            call()
            self.wait()
            if number >= 3:
                times.append((time.perf_counter() - start) * 1e3)
        return statistics.median(times)

    def kernel_ms(self, call: Callable[[], object]) -> float:
        """Time of all kernels of a call, one after the other."""
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            call()
            self.wait()
        return sum(event.self_device_time_total for event in profile.key_averages()) / 1e3

    @contextmanager
    def peak_mb(self, row: dict) -> Iterator[None]:
        """Adds the peak of the device's memory within to a row."""
        if self.is_cuda:
            torch.cuda.reset_peak_memory_stats()
        yield
        if self.is_cuda:
            row["peak MB"] = torch.cuda.max_memory_allocated() / 1e6


def on(load: Workload, device: torch.device, dtype: torch.dtype = torch.float32) -> Workload:
    """A workload on a device."""
    means, quats, scales, opacities, features = (
        values.detach().to(device, dtype).requires_grad_() for values in load.gaussians
    )
    of_features, of_depth, of_alpha = (values.to(device, dtype) for values in load.incoming)
    return replace(
        load,
        gaussians=(means, quats, scales, opacities, features),
        pose=load.pose.to(device, dtype),
        intrinsics=load.intrinsics.to(device, dtype),
        incoming=(of_features, of_depth, of_alpha),
    )


def rasterizer(target: Device, names: list[str]) -> Iterator[dict]:
    """Times of the workloads."""
    for name in names:
        load = on(make_workload(name, CHANNELS), target.device)
        row: dict = {"case": f"{name} {len(load.gaussians[0])} Gaussians {load.width}x{load.height}"}

        def render(load: Workload = load) -> None:
            with torch.no_grad():
                load.forward(target.backend)

        def step(load: Workload = load) -> None:
            load.forward_backward(target.backend)

        with target.peak_mb(row):
            row |= {"render ms": target.ms(render), "with gradients ms": target.ms(step)}
        if target.is_cuda:
            for label, call in (("render ms", render), ("with gradients ms", step)):
                row[f"outside kernels, {label.removesuffix(' ms')}"] = 1 - target.kernel_ms(call) / row[label]
        yield row


def parity(target: Device, names: list[str]) -> Iterator[dict]:
    """Pictures and gradients against the CPU route and the reference in float64."""
    for name in names:
        load = make_workload(name, CHANNELS)
        images = _rendered(on(load, target.device), target.backend)
        others = {"CPU": (torch.float32, "cpu"), "reference": (torch.float64, "reference")}
        for label, (dtype, backend) in others.items():
            expected = _rendered(on(load, torch.device("cpu"), dtype), backend)
            error = torch.stack([(a - b).abs().amax(-1) for a, b in zip(images, expected, strict=True)]).amax(0)
            off = float((error > THRESHOLD).double().mean())
            mine = _gradients(on(load, target.device), target.backend, error < THRESHOLD)
            theirs = _gradients(on(load, torch.device("cpu"), dtype), backend, error < THRESHOLD)
            relative = [float((a - b).norm() / b.norm()) for a, b in zip(mine, theirs, strict=True)]
            kept = error[error < THRESHOLD]
            yield {
                "case": f"{name} against {label}",
                "pixels off": off,
                "worst other": float(kept.max()) if len(kept) else 0.0,
                "gradients off, relative": max(relative),
            }


def _rendered(load: Workload, backend: str) -> list[torch.Tensor]:
    """Features, depth and alpha in float64 on the host."""
    with torch.no_grad():
        raster = load.forward(backend)
    return [image.double().cpu() for image in (raster.features, raster.depth[..., None], raster.alpha[..., None])]


def _gradients(load: Workload, backend: str, where: torch.Tensor) -> list[torch.Tensor]:
    """Gradients of the Gaussians in float64 on the host; only some pixels (bool, [1,h,w]) have any."""
    mask = where.to(load.pose.device)
    incoming = tuple(values * (mask[..., None] if values.ndim == 4 else mask) for values in load.incoming)
    raster = load.forward(backend)
    gradients = torch.autograd.grad((raster.features, raster.depth, raster.alpha), load.gaussians, incoming)
    return [values.double().cpu() for values in gradients]


def psnr(target: Device, options: argparse.Namespace) -> Iterator[dict]:
    """The same video fitted on both routes."""
    video = make_scene("push", 0, options.frames // 2, options.width // 2, options.height // 2)
    seen = video.render(video.camera)
    held_out_db = {}
    for device in ("cpu", target.backend):
        config = _config(options, device)
        scene = reconstruct(View(seen.rgb, video.camera, seen.depth), config)
        held_out_db[device] = decibels(float(scene.windows[0].self_check.fitted_error.mean()))
        steps = scene.windows[0].fit_steps
        yield {
            "case": f"fit on {device}",
            "held-out dB": held_out_db[device],
            "ms per step": 1e3 * scene.seconds["fit"] / steps,
        }
    yield {"case": "difference", "held-out dB": held_out_db[target.backend] - held_out_db["cpu"]}


def episode(target: Device, options: argparse.Namespace, folder: Path) -> Iterator[dict]:
    """A whole episode by the command, and its parts."""
    root = _dataset((options.datasets or folder) / "one", 1, options.frames, options.width, options.height)
    size = f"{options.frames} frames {options.width}x{options.height}, 2 variants, {options.recipe}"
    for start in ("cold", "again"):
        row: dict = {"case": f"{size}, {start}"}
        with target.peak_mb(row):
            row["whole s"] = _augmented(root, folder / f"out_{start}", options, target)
        yield row
    config = _config(options, target.backend)
    source = open_source("local/bench", root)
    view = read_episode(source, 0, [KEY], config.camera).views[KEY]
    row = {"case": "its fit"}
    with target.peak_mb(row):
        scene = reconstruct(view, config)
    yield {"case": "seconds by step"} | scene.seconds
    row |= {"fit s": scene.seconds["fit"], "ms per step": 1e3 * scene.seconds["fit"] / scene.windows[0].fit_steps}
    if target.is_cuda:
        row["outside kernels"] = 1 - _fit_kernel_ms(target, view, config) / row["ms per step"]
    yield row
    ready = for_many_views(scene, target.device)
    camera = new_cameras({KEY: ready}, config, 0, 0).cameras[KEY]
    row = {"case": "rendering through a new camera"}
    with target.peak_mb(row):
        for name, call in (
            ("frames per s, rendered alone", lambda: list(render_frames(ready.windows[0].scene, camera))),
            ("frames per s, holes filled, on the host", lambda: list(new_pictures(ready, camera))),
        ):
            row[name] = 1e3 * len(camera) / target.ms(call, runs=3)
    yield row


def _fit_kernel_ms(target: Device, view: View, config: AugmentConfig, steps: int = 100) -> float:
    """Time of all kernels of a step of the fit."""
    short = replace(config, fit=replace(config.fit, steps=steps, moving_gain_from=1.0, held_out_frames=0))
    kernel_ms = []

    def profiled(draft: Draft) -> None:
        kernel_ms.append(target.kernel_ms(lambda: STEPS["fit"](draft)))

    reconstruct(view, short, steps=with_steps({"fit": profiled}))
    return kernel_ms[0] / steps


def several(target: Device, options: argparse.Namespace, folder: Path) -> Iterator[dict]:
    """Short episodes one after the other, and at the same time."""
    count = options.episodes
    root = _dataset(
        (options.datasets or folder) / "several", count, options.frames // 3, options.width // 2, options.height // 2
    )
    for at_once in (1, count):
        row: dict = {"case": f"{count} short episodes, {at_once} at once"}
        with target.peak_mb(row):
            row["whole s"] = _augmented(root, folder / f"out_{at_once}", options, target, at_once)
        yield row


def _config(options: argparse.Namespace, device: str) -> AugmentConfig:
    config = parse_config(AugmentConfig, ["--recipe", options.recipe], {}, command="benchmark")
    config.device, config.priors.cache = device, "off"  # type: ignore[assignment]
    if options.steps is not None:
        config.fit.steps = options.steps
    return config


def _dataset(root: Path, episodes: int, frames: int, width: int, height: int) -> Path:
    if root.exists():
        return root
    scenes = [make_scene("push", 0, frames, width, height, episode=index) for index in range(episodes)]
    write_dataset(scenes, "local/bench", root, cameras=["front"], depth=True)
    return root


def _augmented(root: Path, out: Path, options: argparse.Namespace, target: Device, at_once: int = 1) -> float:
    """Seconds of the command."""
    flags = {"repo": "local/bench", "root": root, "new_root": out, "recipe": options.recipe, "variants": 2}
    flags |= {"device": target.backend, "priors.cache": "off", "workers": at_once} | ALL_KEPT
    if options.steps is not None:
        flags["fit.steps"] = options.steps
    start = time.perf_counter()
    code = augment.run([f"--{name}={value}" for name, value in flags.items()])
    target.wait()
    if code != 0:
        sys.stdout.write(f"  augment ended with {code}\n")
    return time.perf_counter() - start


def _said(row: dict) -> str:
    values = (f"{name} {value:.4g}" for name, value in row.items() if name not in ("case", "part"))
    return f"  {row['case']}: {', '.join(values)}\n"


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--workloads", nargs="+", default=["W1", "W2", "HD"], help="of the rasterizer: W1, W2, W3, HD")
    parser.add_argument("--parity", nargs="+", default=["W1", "W2", "W3"], help="workloads of the parity")
    parser.add_argument("--recipe", default="balanced")
    parser.add_argument("--steps", type=int, help="of the fit; default: the recipe's")
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--datasets", type=Path, help="folder of the synthetic datasets; those found there are used")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    target = Device(options.device)
    name = torch.cuda.get_device_name() if target.is_cuda else "CPU"
    sys.stdout.write(f"{name}, torch {torch.__version__}\n")
    rows: list[dict] = []
    with tempfile.TemporaryDirectory() as folder:
        parts: dict[str, Callable[[], Iterator[dict]]] = {
            "rasterizer": lambda: rasterizer(target, options.workloads),
            "parity": lambda: parity(target, options.parity),
            "psnr": lambda: psnr(target, options),
            "episode": lambda: episode(target, options, Path(folder)),
            "several": lambda: several(target, options, Path(folder)),
        }
        for part in options.parts:
            sys.stdout.write(f"{part}\n")
            for row in parts[part]():
                rows.append({"part": part} | row)
                sys.stdout.write(_said(row))
                sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
