"""Times the CPU rasterizer against the torch reference.

    OMP_WAIT_POLICY=passive python benchmarks/rasterizer.py [--gate] [--fit] [--json FILE]

Without that policy, torch's idle threads keep spinning and take the processor from other work. Both rasterizers are
run in turn in one process, so that a busy machine slows both alike; ratios are the figures to compare.
`cpu ms` is the processor time of the calling thread when it runs alone, which ignores being descheduled.

Workloads: Gaussians on and above a table seen from a tabletop camera, spread evenly over the image, of log-normal
size (mean radius about 6 px, measured to 3.33 standard deviations along the longer axis) and opacity 0.1 to 0.95.
`channels` counts features and depth together.
"""

import argparse
import json
import math
import resource
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from lerobot_msdyn.core.geometry import quaternion_to_matrix, transform_points
from lerobot_msdyn.render import Raster, rasterize
from lerobot_msdyn.render.cpu import rasterizer as cpu_backend
from lerobot_msdyn.render.types import COVARIANCE_BLUR, MIN_ALPHA

WORKLOADS = {"W1": (20_000, 320, 240), "W2": (60_000, 640, 480), "W3": (5_000, 160, 120)}  # Gaussians, px, px
LARGE = {"HD": (200_000, 1280, 720)}  # for a GPU (benchmarks/gpu.py)
LEAST_RATIO = {"W1": 20.0, "W2": 17.0}  # forward and backward, 8 channels, 1 thread
VECTOR_OPERATIONS = {
    "composite_forward": 28,
    "composite_backward": 48,
}  # per rendered pixel at 8 channels, by hand count
SLOWER_THAN_BASELINE = 1.25  # of the ratio to the reference
BASELINE = Path(__file__).with_suffix(".json")


Gaussians = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]  # means, quats, scales, opacities, features


@dataclass(frozen=True)
class Workload:
    """A scene, its camera, and gradients to send back."""

    gaussians: Gaussians
    pose: Tensor
    intrinsics: Tensor
    width: int
    height: int
    incoming: tuple[Tensor, Tensor, Tensor]

    def forward(self, backend: str) -> Raster:
        return rasterize(*self.gaussians, self.pose, self.intrinsics, self.width, self.height, backend=backend)

    def forward_backward(self, backend: str) -> None:
        raster = self.forward(backend)
        torch.autograd.grad((raster.features, raster.depth, raster.alpha), self.gaussians, self.incoming)


def make_workload(name: str, channels: int, seed: int = 0) -> Workload:
    """One of `WORKLOADS` or `LARGE`, with `channels` - 1 features."""
    count, width, height = (WORKLOADS | LARGE)[name]
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    focal = 0.95 * width
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    eye = torch.tensor([0.0, -0.75, 0.6])  # m; the camera looks at the middle of the table, z is up
    forward, right = -eye / eye.norm(), torch.tensor([1.0, 0, 0])
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    pixels = uniform(-0.03, 1.03, count, 2) * torch.tensor([width, height])
    rays = torch.cat(((pixels - torch.tensor([width, height]) / 2) / focal, torch.ones(count, 1)), 1) @ rotation
    table = torch.where(rays[:, 2] < -0.15, -eye[2] / rays[:, 2].clamp(max=-0.15), 2.5).clamp(max=2.5)
    raised = torch.rand(count, generator=generator) < 0.35
    depth = table * torch.where(raised, uniform(0.72, 0.99, count), 1 + 0.004 * normal(count))
    size = 4.5 / 3.33 * 0.8 * depth / focal * torch.exp(0.45 * normal(count))
    gaussians = (
        eye + rays * depth[:, None],
        normal(count, 4),
        size[:, None] * torch.exp(0.45 * normal(count, 3)),
        uniform(0.1, 0.95, count),
        uniform(0, 1, count, channels - 1),
    )
    incoming = (
        normal(1, channels - 1, height, width).permute(0, 2, 3, 1),
        normal(1, height, width),
        normal(1, height, width),
    )
    for values in gaussians:
        values.requires_grad_()
    return Workload(gaussians, pose[None], intrinsics[None], width, height, incoming)


def interleaved(first: Callable[[], object], second: Callable[[], object], rounds: int) -> list[list[float]]:
    """Wall ms of both, and processor ms of this thread in the first, alternating; after one warm-up each.

    The first is so much faster that each of its samples is the median of several runs.
    """
    first()
    second()
    samples: list[list[float]] = [[], [], []]
    for _ in range(rounds):
        inner = [timed(first) for _ in range(5)]
        samples[0].append(statistics.median(wall for wall, _ in inner))
        samples[2].append(statistics.median(cpu for _, cpu in inner))
        samples[1].append(timed(second)[0])
    return samples


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Wall and thread-processor ms of a call."""
    wall, cpu = time.perf_counter(), time.thread_time()
    call()
    return (time.perf_counter() - wall) * 1e3, (time.thread_time() - cpu) * 1e3


def measure(name: str, channels: int, threads: int, rounds: int) -> list[dict]:
    """Rows of the report for one workload."""
    torch.set_num_threads(threads)
    load = make_workload(name, channels)
    rows = []
    for label, method in (("fwd", load.forward), ("fwd_bwd", load.forward_backward)):

        def run(backend: str, method: Callable = method, gradients: bool = label != "fwd") -> None:
            with torch.set_grad_enabled(gradients):
                method(backend)

        ours, reference, cpu = interleaved(lambda: run("cpu"), lambda: run("reference"), rounds)
        row = {
            "workload": name,
            "channels": channels,
            "pass": label,
            "threads": threads,
            "ms": statistics.median(ours),
            "best_ms": min(ours),
            "reference_ms": statistics.median(reference),
            "ratio": statistics.median(theirs / mine for mine, theirs in zip(ours, reference, strict=True)),
        }
        if threads == 1:
            row["cpu_ms"] = min(cpu)
        rows.append({key: round(v, 3) if isinstance(v, float) else v for key, v in row.items()})
    return rows


def cost_split(name: str, channels: int) -> dict[str, float]:
    """Processor ms of each kernel on one thread (least of 15 runs), and the MB that a call works with."""
    torch.set_num_threads(1)
    load = make_workload(name, channels)
    times: dict[str, list[float]] = defaultdict(list)
    original, sizes = cpu_backend.run, {}

    def timed_run(kernel: Callable, items: int, *arguments: object) -> None:
        times[kernel.__name__].append(timed(lambda: original(kernel, items, *arguments))[1])
        arrays = {id(a): a.nbytes for a in arguments if hasattr(a, "nbytes")}
        sizes[kernel.__name__] = sum(arrays.values()) / 1e6

    cpu_backend.run = timed_run
    try:
        for _ in range(15):
            load.forward_backward("cpu")
    finally:
        cpu_backend.run = original
    split = {kernel: round(min(values), 3) for kernel, values in times.items()}
    pixels, rate = rendered_pixels(load), lane_operations_per_ms()
    peak = {
        f"{kernel}_share_of_peak": round(pixels * 1e6 * operations / rate / split[kernel], 2)
        for kernel, operations in VECTOR_OPERATIONS.items()
    }
    return {**split, **peak, "memory_mb": round(max(sizes.values()), 1), "pixels_rendered_millions": pixels}


def lane_operations_per_ms() -> float:
    """Vector operations, counted by lane, that one thread can do: the multiply-adds of a matrix product, the best of 9.

    With it, the share of the peak is that of an ideal kernel that only blends the pixels that are rendered.
    """
    a = torch.rand(768, 768)
    return len(a) ** 3 / min(timed(lambda: a @ a)[1] for _ in range(9))


def rendered_pixels(load: Workload) -> float:
    """Millions of (Gaussian, pixel) pairs with an alpha of at least 1/255, from the areas of the ellipses."""
    means, quats, scales, opacities, _ = (values.detach().double() for values in load.gaussians)
    pose, focal = load.pose[0].double(), load.intrinsics[0, 0, 0].double()
    x, y, z = transform_points(pose, means).unbind(-1)
    zero = torch.zeros_like(z)
    rows = (focal / z, zero, -focal * x / z**2, zero, focal / z, -focal * y / z**2)
    spread = torch.stack(rows, 1).reshape(-1, 2, 3) @ pose[:3, :3] @ (quaternion_to_matrix(quats) * scales[:, None])
    covariance = spread @ spread.transpose(1, 2) + COVARIANCE_BLUR * torch.eye(2, dtype=torch.float64)
    area = 2 * math.pi * torch.log(opacities / MIN_ALPHA) * torch.linalg.det(covariance).sqrt()
    return round(area.sum().item() / 1e6, 2)


def fit_picture(steps: int = 300) -> dict[str, float]:
    """Fit 5000 Gaussians to a 320 x 240 picture with Adam; ms per step and final PSNR."""
    generator = torch.Generator().manual_seed(0)
    count, width, height = 5_000, 320, 240
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    disc = ((x.square() + y.square()) < 0.4).float()
    picture = torch.stack(
        (0.5 + 0.4 * torch.sin(9 * x + 4 * y), 0.2 + 0.6 * disc, 0.5 + 0.4 * torch.cos(11 * x * y)), -1
    )
    intrinsics = torch.tensor([[[160.0, 0, 160], [0, 160, 120], [0, 0, 1]]])
    means = torch.rand(count, 3, generator=generator) * torch.tensor([2.0, 1.5, 0.2]) + torch.tensor([-1, -0.75, 0.9])
    raw = {
        "means": means,
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.full((count, 3), math.log(0.015)),
        "opacities": torch.zeros(count),
        "features": torch.zeros(count, 3),
    }
    rates = {"means": 2e-3, "quats": 5e-3, "scales": 1e-2, "opacities": 3e-2, "features": 3e-2}
    optimizer = torch.optim.Adam([{"params": [raw[key].requires_grad_()], "lr": rate} for key, rate in rates.items()])
    start = time.perf_counter()
    for _ in range(steps):
        optimizer.zero_grad()
        raster = rasterize(
            raw["means"], raw["quats"], raw["scales"].exp(), raw["opacities"].sigmoid(), raw["features"].sigmoid(),
            torch.eye(4)[None], intrinsics, width, height, backend="cpu",
        )  # fmt: skip
        loss = (raster.features[0] - picture).square().mean()
        loss.backward()
        optimizer.step()
    seconds = time.perf_counter() - start
    return {"ms_per_step": round(seconds / steps * 1e3, 2), "psnr_db": round(-10 * math.log10(loss.item()), 2)}


def violations(rows: list[dict], baseline: list[dict]) -> list[str]:
    """What `--gate` refuses: one-thread ratios below the least, or well below the committed baseline's."""
    keys = ("workload", "channels", "pass", "threads")
    before = {tuple(row[key] for key in keys): row["ratio"] for row in baseline}
    failures = []
    for row in (row for row in rows if row["threads"] == 1):
        name = " ".join(str(row[key]) for key in keys)
        if (row["channels"], row["pass"]) == (8, "fwd_bwd"):
            least = LEAST_RATIO.get(row["workload"], 0)
            if row["ratio"] < least:
                failures.append(f"{name}: {row['ratio']} times the reference; expected at least {least}")
        past = before.get(tuple(row[key] for key in keys))
        if past is not None and row["ratio"] * SLOWER_THAN_BASELINE < past:
            failures.append(f"{name}: {row['ratio']} times the reference; the baseline has {past}")
    return failures


def report(rows: list[dict]) -> None:
    print(f"{'':4}{'C':>3} {'pass':8}{'thr':>4}{'ms':>9}{'best':>9}{'cpu ms':>9}{'reference':>11}{'ratio':>8}")
    for row in rows:
        cpu = f"{row['cpu_ms']:9.2f}" if "cpu_ms" in row else " " * 9
        print(
            f"{row['workload']:4}{row['channels']:3} {row['pass']:8}{row['threads']:4}{row['ms']:9.2f}"
            f"{row['best_ms']:9.2f}{cpu}{row['reference_ms']:11.1f}{row['ratio']:8.1f}"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workloads", nargs="+", choices=WORKLOADS, default=list(WORKLOADS))
    parser.add_argument("--channels", nargs="+", type=int, default=[4, 8])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--gate", action="store_true", help=f"fail where slower than demanded or than {BASELINE.name}")
    parser.add_argument("--fit", action="store_true", help="also fit a picture")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.workloads:
        for channels in arguments.channels:
            for threads in arguments.threads:
                rows += measure(name, channels, threads, arguments.rounds)
    report(rows)
    for name in arguments.workloads:
        print(name, "one thread, 8 channels, ms of the processor:", cost_split(name, 8))
    if arguments.fit:
        torch.set_num_threads(max(arguments.threads))
        print("fit of a picture:", fit_picture())
    print(f"peak memory of this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    wrong = violations(rows, json.loads(BASELINE.read_text())) if arguments.gate else []
    print(*wrong, sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
