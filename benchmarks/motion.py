"""Times the composition of motion levels, and measures how well levels explain known motions.

    OMP_WAIT_POLICY=passive python benchmarks/motion.py [--quick] [--json FILE]
    ... benchmarks/motion.py --sim FOLDER [--scenes rigid_push,pick_place] [--noise_px 1] [--seed 0] [--gate on]

* `time`: forward and backward of `compose` for a scene of 3 objects, 15 primitives and 150 grains, bound as Gaussians
  are. `dense` is the same call where every Gaussian names all bases of each level, `matrix` the same again with the
  mixture written as a product of matrices. All are run in turn in one process, on one thread; the figures are medians
  of its processor time, which ignores being descheduled. Gradients go to means, logits, rotations and displacements.
* `tracks`: three synthetic bodies (3,000 tracks, 60 frames, 2 mm noise, 35 % missing, gaps besides), per set of levels
  and with and without the gate. The error is that of the true canonical points carried to every frame.
* `sim`: simulated episodes in FOLDER (see simulated.py), initialised from true tracks with noise and 30 % of their
  positions dropped. The error is that of other points, predicted in all frames where they are seen from one of them:
  the mean over the frames of each, then mean and median over the points.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import rivals
import torch
from simulated import OBJECT, ROBOT, Simulated, dense_tracks, instance_of, observed, read_simulated
from torch import Tensor

from lerobot_msdyn.core.config import MotionConfig
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.motion.estimate import motion_from_tracks, scene_motion
from lerobot_msdyn.motion.from_tracks.lift import LiftedTracks
from lerobot_msdyn.motion.model import bases
from lerobot_msdyn.motion.model.bases import COARSEST, MotionLevel, level_from_motions, with_idle
from lerobot_msdyn.motion.model.compose import compose
from lerobot_msdyn.motion.model.scene_motion import SceneMotion, bind
from lerobot_msdyn.synthetic.bodies import BODY_KINDS, TrackedBody, tracked_body

rivals.register()
HIERARCHY = ("object", "primitive", "grain")
OBJECTS, PRIMITIVES, GRAINS = 3, 5, 10  # of the scene, of an object, of a primitive
FRAMES = 60
LEAST_RATIO = 5.0  # of dense to sparse, demanded of 20,000 Gaussians
DROPPED = 0.3  # share of the positions of the simulated tracks
SCENES = "rigid_push,pick_place,deformable,free_arm"
VARIANTS = (
    MotionConfig(levels=["object"]),
    MotionConfig(levels=["object", "primitive"]),
    MotionConfig(levels=["object", "primitive"], primitives=10),  # the paper's L2+
    MotionConfig(levels=["object", "primitive", "grain"]),
    MotionConfig(levels=["object", "primitive", "grain", "particle"]),  # the paper's L4
    MotionConfig(levels=["flat"]),
    MotionConfig(levels=["field"]),
)


@dataclass(frozen=True)
class Load:
    """Gaussians and what they follow; `arguments` are those of `compose`."""

    arguments: tuple
    leaves: tuple[Tensor, ...]  # that take gradients
    incoming: tuple[Tensor, Tensor]

    def forward_backward(self) -> None:
        torch.autograd.grad(compose(*self.arguments), self.leaves, self.incoming)


def random_level(parents: Tensor, generator: torch.Generator) -> MotionLevel:
    """Bases anywhere in a cube of 1 m, with small motions."""
    count = len(parents)
    turns = axis_angle_to_matrix(0.2 * torch.randn(count, FRAMES, 3, generator=generator))
    motions = se3(turns, 0.05 * torch.randn(count, FRAMES, 3, generator=generator))
    reach = torch.full((count,), 0.2)
    return level_from_motions(motions, torch.rand(count, 3, generator=generator), reach=reach, parents=parents)


def make_load(gaussians: int, times: int, scale: int = 1, *, dense: bool = False, seed: int = 0) -> Load:
    """`gaussians` in a scene of `scale` times 3 objects; dense: every one names all bases, most with no weight."""
    generator = torch.Generator().manual_seed(seed)
    objects = OBJECTS * scale
    primitives = torch.arange(objects).repeat_interleave(PRIMITIVES)
    grains = torch.arange(len(primitives)).repeat_interleave(GRAINS)
    parents = (torch.full((objects,), COARSEST), primitives, grains)
    levels = [random_level(of_level, generator) for of_level in parents]
    levels[-1] = with_idle(levels[-1])
    means = torch.rand(gaussians, 3, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(gaussians, 4, generator=generator), dim=-1)
    part = torch.randint(objects, (gaussians,), generator=generator)
    indices, logits = bind(HIERARCHY, tuple(levels), means, part)
    if dense:
        pairs = [_all_bases(*each) for each in zip(indices, logits, map(len, levels), strict=True)]
        indices, logits = zip(*pairs, strict=True)
    incoming = (
        torch.randn(times, gaussians, 3, generator=generator),
        torch.randn(times, gaussians, 4, generator=generator),
    )
    frames = torch.linspace(0, FRAMES - 1, times)
    learned = [
        replace(level, **{name: getattr(level, name).requires_grad_() for name in ("rotations_6d", "displacements")})
        for level in levels
    ]
    leaves = (means, *logits, *(t for level in learned for t in (level.rotations_6d, level.displacements)))
    for leaf in leaves:
        leaf.requires_grad_()
    return Load((means, quats, tuple(learned), indices, logits, frames), leaves, incoming)


def _all_bases(indices: Tensor, logits: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The same mixture with all bases of a level named."""
    named = torch.full((len(indices), count), -torch.inf).scatter_(1, indices, logits)
    return torch.arange(count).repeat(len(indices), 1), named


def blend_by_matrix(affines: Tensor, indices: Tensor, logits: Tensor) -> Tensor:
    """`bases.blend` of points that name all bases in order, as one product of matrices."""
    mixed = torch.softmax(logits, dim=-1) @ affines.flatten(1)
    return mixed.reshape(len(indices), affines.shape[1], 3, 4).transpose(0, 1)


def medians(calls: list[Callable[[], None]], rounds: int) -> list[float]:
    """Median processor ms of this thread in each call, run in turn, after one warm-up each."""
    samples: list[list[float]] = [[] for _ in calls]
    for row in range(rounds + 1):
        for call, times in zip(calls, samples, strict=True):
            start = time.thread_time()
            call()
            if row:
                times.append((time.thread_time() - start) * 1e3)
    return [statistics.median(times) for times in samples]


def compare_routes(gaussians: int, times: int, scale: int, rounds: int) -> dict:
    """Sparse against dense."""
    sparse, dense = (make_load(gaussians, times, scale, dense=dense) for dense in (False, True))

    def by_matrix() -> None:
        with patch.object(bases, "blend", blend_by_matrix):
            dense.forward_backward()

    ms = medians([sparse.forward_backward, dense.forward_backward, by_matrix], rounds)
    row: dict[str, int | float] = {"gaussians": gaussians, "times": times, "scale": scale}
    row |= {f"{name}_ms": round(value, 2) for name, value in zip(("sparse", "dense", "matrix"), ms, strict=True)}
    return row | {"dense_ratio": round(ms[1] / ms[0], 2), "matrix_ratio": round(ms[2] / ms[0], 2)}


def growth(gaussians: int, rounds: int) -> list[dict]:
    """Sparse time with more times, Gaussians and bases, relative to `gaussians` at one time."""
    settings = [{"times": t} for t in (1, 2, 5)] + [{"gaussians": gaussians * k // 4} for k in (1, 16)]
    settings += [{"scale": scale} for scale in (2, 4)]
    complete = [{"gaussians": gaussians, "times": 1, "scale": 1} | setting for setting in settings]
    ms = medians(
        [make_load(setting["gaussians"], setting["times"], setting["scale"]).forward_backward for setting in complete],
        rounds,
    )
    return [
        setting | {"sparse_ms": round(value, 2), "relative": round(value / ms[0], 2)}
        for setting, value in zip(complete, ms, strict=True)
    ]


def gates(levels: list[str], gate: str) -> list[bool]:
    """Settings of the gate that are asked for; without finer levels there is nothing to decide."""
    return [True] if len(levels) == 1 else {"on": [True], "off": [False], "both": [True, False]}[gate]


def kept(motion: SceneMotion) -> dict[str, str]:
    """For each level, how many of its bases move."""
    levels = zip(motion.names, motion.levels, strict=True)
    return {name: f"{int(level.active.sum())}/{len(level)}" for name, level in levels if isinstance(level, MotionLevel)}


def described(config: MotionConfig, motion: SceneMotion) -> dict:
    """What was fitted and what was kept of it, for a row of the report."""
    row = {"levels": list(config.levels), "gate": config.gate}
    if "primitive" in config.levels:
        row["primitives"] = config.primitives
    return row | {"kept": kept(motion)}


def track_error(motion: SceneMotion, body: TrackedBody, points: Tensor) -> float:
    """Mean distance (mm) from the truth of canonical points carried to every frame."""
    moved, _ = motion.moved(points, motion.part, torch.arange(body.truth.shape[1]))
    return round(1e3 * float((moved.transpose(0, 1) - body.truth).norm(dim=-1).mean()), 3)


def track_scenes(tracks: int, frames: int, gate: str, variants: list[MotionConfig]) -> Iterator[dict]:
    """Errors of the synthetic bodies."""
    for kind in BODY_KINDS:
        body = tracked_body(kind, tracks=tracks, frames=frames)
        seen = LiftedTracks(
            body.seen, body.valid, body.valid.float(), torch.ones(tracks, dtype=torch.long), pixel_m=0.002
        )
        for variant in variants:
            for setting in gates(variant.levels, gate):
                config = replace(variant, gate=setting, max_parts=1)
                start = time.perf_counter()
                motion = motion_from_tracks(seen, config)
                seconds = time.perf_counter() - start
                yield {
                    "scene": kind,
                    **described(config, motion),
                    "error_mm": track_error(motion, body, body.truth[:, motion.canonical_frame]),
                    "estimated_points_mm": track_error(motion, body, motion.points),
                    "seconds": round(seconds, 1),
                }


def sim_errors(motion: SceneMotion, episode: Simulated) -> Tensor:
    """Mean error (mm) of each point that was kept for testing, over the frames in which it is seen."""
    errors, instance = torch.zeros(len(episode.body)), instance_of(episode.body)
    for frame in episode.query.unique().tolist():
        rows = (episode.query == frame).nonzero()[:, 0]
        points, part = motion.to_canonical(episode.xyz[rows, frame], frame, instance[rows])
        moved, _ = motion.moved(points, part, torch.arange(len(episode.depth)))
        seen = episode.visible[rows]
        distance = (moved.transpose(0, 1) - episode.xyz[rows]).norm(dim=-1)
        errors[rows] = 1e3 * (distance * seen).sum(1) / seen.sum(1)
    return errors


def sim_scene(
    folder: Path, tracks: int, noise_px: float, seed: int, gate: str, variants: list[MotionConfig]
) -> Iterator[dict]:
    """Errors of one simulated episode."""
    episode = read_simulated(folder)
    seen = observed(dense_tracks(episode, tracks, seed), noise_px, DROPPED, seed)
    instance = instance_of(episode.body)
    for variant in variants:
        for setting in gates(variant.levels, gate):
            config = replace(variant, gate=setting)
            start = time.perf_counter()
            motion = scene_motion(seen, episode.depth, episode.camera, config)
            seconds = time.perf_counter() - start
            assert motion is not None
            errors = sim_errors(motion, episode)
            row = {"scene": folder.name, "noise_px": noise_px, "seed": seed, **described(config, motion)}
            groups = (("", instance > 0), ("robot_", instance == ROBOT), ("object_", instance == OBJECT))
            for name, members in groups:
                if members.any():
                    row[f"{name}error_mm"] = round(float(errors[members].mean()), 2)
                    row[f"{name}median_mm"] = round(float(errors[members].median()), 2)
            yield row | {"seconds": round(seconds, 1)}


def printed(title: str, rows: Iterator[dict] | list[dict]) -> list[dict]:
    """The rows, each printed as soon as it is known."""
    print(title)
    result = []
    for row in rows:
        shown = {key: "+".join(value) if key == "levels" else value for key, value in row.items()}
        print("  " + "  ".join(f"{key} {value}" for key, value in shown.items()).replace("'", ""), flush=True)
        result.append(row)
    return result


def parse(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("time", "tracks", "sim"), help="one of the three studies")
    parser.add_argument("--rounds", type=int, default=9, help="of each timing")
    parser.add_argument("--gate", choices=("on", "off", "both"), help="default: both for tracks, on for sim")
    parser.add_argument("--sim", type=Path, help="folder of simulated episodes")
    parser.add_argument("--scenes", default=SCENES, help="of that folder")
    parser.add_argument("--noise_px", type=float, default=1.0, help="of the simulated tracks")
    parser.add_argument("--seed", type=int, default=0, help="of the points, noise and gaps of the simulated tracks")
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--quick", action="store_true", help="few Gaussians, tracks and rounds: does it run?")
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> None:
    arguments = parse(words)
    torch.set_num_threads(1)
    quick, only, report = arguments.quick, arguments.only, {}
    hierarchies = [VARIANTS[0], VARIANTS[1], VARIANTS[3]]
    if only in (None, "time"):
        gaussians, rounds = (200, 1) if quick else (20_000, arguments.rounds)
        settings = ((1, 1), (5, 1), (1, 4))
        compared = (compare_routes(gaussians, times, scale, rounds) for times, scale in settings)
        report["time"] = printed(f"sparse against dense; demanded: {LEAST_RATIO:.0f} times", compared)
        report["growth"] = printed("growth of the sparse time", growth(gaussians, rounds))
    if only in (None, "tracks"):
        tracks, frames, variants = (60, 8, hierarchies[:2]) if quick else (3000, 60, list(VARIANTS))
        rows = track_scenes(tracks, frames, arguments.gate or "both", variants)
        report["errors"] = printed("synthetic bodies", rows)
    if arguments.sim and only in (None, "sim"):
        tracks, variants = (400, hierarchies[:1]) if quick else (4000, hierarchies)
        report["sim"] = []
        for scene in arguments.scenes.split(","):
            folder, options = arguments.sim / scene, (arguments.noise_px, arguments.seed, arguments.gate or "on")
            rows = sim_scene(folder, tracks, *options, variants)
            report["sim"] += printed(scene, rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
