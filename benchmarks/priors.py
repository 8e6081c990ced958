"""Measures the weights-free priors against the truth, and times them.

    python benchmarks/priors.py --sim FOLDER [--scenes A,B] [--json FILE]
    python benchmarks/priors.py --timing

FOLDER holds scene folders in the layout of docs/evaluate.md with all of `gt/` (`python -m lerobot_msdyn.synthetic
--layout nvs` writes one): `dataset/`, `gt/meta.json`, `gt/train.npz` (depth and seg with time as the last axis),
`gt/bodies.npz`, `gt/tracks.npz`. `NAME/ep05` is episode 5 of a dataset whose truth lies in `NAME/gt/ep05/`. By
default every folder with a `gt/meta.json` is measured, one JSON entry per scene, with what `estimate_priors` gives the
pipeline: pictures at most `fit.max_width` wide, default camera settings, depth from the table plane.

mask_iou            pixels that belong to an instance against pixels of the bodies that move (meta `dynamic_ids`):
                    intersection over union of the pixels of all frames together.
track_median_px     median error of all tracks at all frames, save their first, where both we and the truth see the
                    point. A track's true path: the surface point under it at its first visible frame (true depth, with
                    the true pose of the body under it, moving or not; on a cloth the nearest place on its mesh),
                    carried by that body. The truth sees a point where, at its place, the true depth is the point's (to
                    1 % or 5 mm) and the body is the same.
track_alive_30 ...  of the tracks whose true point is visible 30 (60, 90) frames after their first visible frame, the
                    share that we say is visible then and that is less than 3 px off. Null if there are none.
plane_depth_abs_rel mean of |z - z*| / z* over all pixels and frames, with the default height, tilt and field of view.

The table shows besides: abs_rel with the true camera height, tilt and focal length, over all pixels and over moving
ones only, with and without objects that stand on the table; and `found_60`: of the points in `gt/tracks.npz` that are
visible at their query frame and 60 frames later, the share for which our nearest track (same body, at most 5 px away
at the query frame) is still visible and less than 3 px off its own true path, so that places without any track count
as lost. Errors are in pixels of the pictures that are looked at. Times are processor seconds per 100 frames, over all
threads: they do not depend on what else the machine does.
"""

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from lerobot_msdyn.core.config import CameraConfig, PriorsConfig, Recipe
from lerobot_msdyn.core.geometry import quaternion_to_matrix
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.dataset.read import open_source, read_episode
from lerobot_msdyn.dataset.select import select_cameras
from lerobot_msdyn.priors import PointTracks, estimate_priors
from lerobot_msdyn.priors.depth.table_plane import table_plane, with_standing
from lerobot_msdyn.priors.masks.moving import moving_instances, temporal_median
from lerobot_msdyn.priors.tracks.flow import flow_tracks
from lerobot_msdyn.synthetic import make_scene

AGES = (30, 60, 90)  # frames
LOST_PX = 3.0
NEAR_PX = 5.0
TIMED_SIZES, TIMED_FRAMES = ((320, 240), (640, 480)), (30, 90)


@dataclass(frozen=True)
class Truth:
    """What is true of one recorded video."""

    depth: ndarray  # [t,h,w] m
    seg: ndarray  # [t,h,w] body ids
    moving: ndarray  # [t,h,w] whether the pixel's body is one of those that move
    intrinsics: ndarray  # [3,3]
    world_from_camera: ndarray  # [t,4,4]
    world_from_body: ndarray  # [t,b,4,4]
    cloth: tuple[int, ndarray, ndarray] | None  # id, vertices [t,v,3], faces [f,3]
    table_z: float  # m, world

    @classmethod
    def read(cls, folder: Path) -> "Truth":
        meta = json.loads((folder / "meta.json").read_text())
        train, bodies = np.load(folder / "train.npz"), np.load(folder / "bodies.npz")
        depth = np.moveaxis(train["depth"], -1, 0).astype(np.float32) * meta["depth_unit_m"]
        seg = np.moveaxis(train["seg"], -1, 0)
        pose = torch.from_numpy(bodies["pose"]).double()  # position, quaternion wxyz
        world_from_body = np.zeros((*pose.shape[:2], 4, 4))
        world_from_body[..., :3, :3] = quaternion_to_matrix(pose[..., 3:]).numpy()
        world_from_body[..., :3, 3] = pose[..., :3].numpy()
        world_from_body[..., 3, 3] = 1
        cloth = meta.get("flex_seg_id"), bodies.get("flex_verts"), bodies.get("flex_faces")
        usable = cloth if all(part is not None for part in cloth) else None
        moving = np.isin(seg, meta["dynamic_ids"])
        truth = cls(depth, seg, moving, train["K"], train["c2w"], world_from_body, usable, 0.0)
        table = [int(i) for i, name in meta["bodies"].items() if name == "table"]
        on_table = np.argwhere(np.isin(seg[0], table))
        if len(on_table) == 0:
            return truth
        height = truth.lift(np.zeros(len(on_table), int), on_table[:, ::-1] + 0.5)[:, 2]
        return cls(depth, seg, moving, train["K"], train["c2w"], world_from_body, usable, float(np.median(height)))

    def body(self, frame: ndarray, xy: ndarray) -> ndarray:
        """The body at positions [n,2] of frames [n]."""
        height, width = self.seg.shape[1:]
        x, y = xy.astype(int).T
        return self.seg[frame, y.clip(0, height - 1), x.clip(0, width - 1)]

    def lift(self, frame: ndarray, xy: ndarray) -> ndarray:
        """World positions [n,3] of the surface seen at [n,2]; depth is interpolated within the body."""
        height, width = self.seg.shape[1:]
        own = self.body(frame, xy)
        corner = np.floor(xy - 0.5).astype(int)
        share = xy - 0.5 - corner
        depth, total = np.zeros(len(xy)), np.zeros(len(xy))
        for dx in (0, 1):
            for dy in (0, 1):
                x, y = (corner[:, 0] + dx).clip(0, width - 1), (corner[:, 1] + dy).clip(0, height - 1)
                weight = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1]) + 1e-9
                weight = weight * (self.seg[frame, y, x] == own)
                depth += weight * self.depth[frame, y, x]
                total += weight
        depth /= total
        rays = np.concatenate((xy, np.ones((len(xy), 1))), axis=1) @ np.linalg.inv(self.intrinsics).T
        camera = np.concatenate((rays * depth[:, None], np.ones((len(xy), 1))), axis=1)
        return np.einsum("nij,nj->ni", self.world_from_camera[frame], camera)[:, :3]

    def paths(self, frame: ndarray, xy: ndarray) -> tuple[ndarray, ndarray]:
        """Where the surface points seen at [n,2] are in all frames [n,t,2], and whether they are seen [n,t]."""
        own, start = self.body(frame, xy), self.lift(frame, xy)
        known = np.minimum(own, self.world_from_body.shape[1] - 1)
        homogeneous = np.concatenate((start, np.ones((len(xy), 1))), axis=1)
        local = np.linalg.solve(self.world_from_body[frame, known], homogeneous[..., None])[..., 0]
        world = np.einsum("tnij,nj->nti", self.world_from_body[:, known], local)[..., :3]
        if self.cloth is not None:
            on_cloth = np.nonzero(own == self.cloth[0])[0]
            for i in on_cloth:
                world[i] = self._on_cloth(int(frame[i]), start[i])
        camera = np.linalg.inv(self.world_from_camera)
        seen_from = np.einsum("tij,ntj->nti", camera[:, :3, :3], world) + camera[:, :3, 3]
        pixel = seen_from @ self.intrinsics.T
        place = pixel[..., :2] / np.maximum(pixel[..., 2:], 1e-6)
        return place, self._is_seen(own, place, seen_from[..., 2])

    def _on_cloth(self, frame: int, point: ndarray) -> ndarray:
        """The path [t,3] of a point that keeps its place on, and its distance from, the nearest triangle."""
        assert self.cloth is not None
        _, vertices, faces = self.cloth
        a, b, c = (vertices[frame, faces[:, k]].astype(float) for k in range(3))
        edges = np.stack((b - a, c - a, np.cross(b - a, c - a) / 0.01), axis=-1)
        share = np.linalg.solve(edges, (point - a)[..., None])[..., 0]
        outside = np.maximum(0, np.maximum(-share[:, :2].min(1), share[:, :2].sum(1) - 1))
        face = int(np.argmin(10 * outside + np.abs(share[:, 2])))
        a, b, c = (vertices[:, faces[face, k]].astype(float) for k in range(3))
        return a + share[face, 0] * (b - a) + share[face, 1] * (c - a) + share[face, 2] * np.cross(b - a, c - a) / 0.01

    def _is_seen(self, own: ndarray, place: ndarray, z: ndarray) -> ndarray:
        frames, height, width = self.seg.shape
        inside = (z > 0) & (place >= 0).all(-1) & (place[..., 0] < width) & (place[..., 1] < height)
        time = np.arange(frames)
        corner = np.floor(place - 0.5).clip(-2, 9999).astype(int)
        seen = np.zeros(inside.shape, bool)
        for dx in (0, 1):
            for dy in (0, 1):
                x, y = (corner[..., 0] + dx).clip(0, width - 1), (corner[..., 1] + dy).clip(0, height - 1)
                alike = np.abs(self.depth[time, y, x] - z) < np.maximum(0.005, 0.01 * z)
                seen |= alike & (self.seg[time, y, x] == own[:, None])
        return seen & inside


def measure(folder: Path, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The JSON entry of one scene, and the further columns of the table."""
    scene, _, part = name.partition("/")
    truth = Truth.read(folder / scene / "gt" / part)
    recipe = Recipe()
    source = open_source(f"local/{scene}", folder / scene / "dataset")
    key = select_cameras(source, None)[0]
    episode = int(part.removeprefix("ep") or 0)
    recorded = read_episode(source, episode, [key], recipe.camera, recorded_depth=False).views[key]
    view = recorded.shrunk(recipe.fit.max_width)
    if view.rgb.shape[:3] != truth.seg.shape:
        raise SystemExit(f"{name}: the pictures are {tuple(view.rgb.shape[:3])}, the truth {truth.seg.shape}")
    start = time.process_time()
    priors = estimate_priors(view, PriorsConfig("plane", "change", "flow", cache="off"), CameraConfig())
    seconds = time.process_time() - start
    found = priors.instances.numpy() > 0
    tracks, more = track_scores(priors.tracks, truth, np.load(folder / scene / "gt" / part / "tracks.npz"))
    entry = {
        "scene": name,
        "mask_iou": round(float((found & truth.moving).sum() / max((found | truth.moving).sum(), 1)), 4),
        **tracks,
        "plane_depth_abs_rel": abs_rel(priors.depth.numpy(), truth.depth),
    }
    return entry, more | _true_plane(view, priors.instances, truth) | {"s/100": round(100 * seconds / len(found), 1)}


def track_scores(tracks: PointTracks, truth: Truth, points: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Median error and survival, see the module's docstring."""
    xy, visible = tracks.xy.numpy().astype(float), tracks.visible.numpy()
    index, first = np.arange(len(xy)), visible.argmax(1)
    path, seen = truth.paths(first, xy[index, first])
    error = np.linalg.norm(xy - path, axis=-1)
    later = np.ones_like(visible)
    later[index, first] = False
    both = visible & seen & later
    right = visible & (error < LOST_PX)
    alive = {}
    for age in AGES:
        lasts = np.nonzero(first + age < visible.shape[1])[0]
        lasts = lasts[seen[lasts, first[lasts] + age]]
        alive[f"track_alive_{age}"] = round(float(right[lasts, first[lasts] + age].mean()), 4) if len(lasts) else None
    median = round(float(np.median(error[both])), 3) if both.any() else None
    more = {
        "tracks": len(xy),
        "p90_px": round(float(np.quantile(error[both], 0.9)), 2) if both.any() else None,
        "ghost": round(float((visible & ~seen).sum() / max(visible.sum(), 1)), 3),
        "found_60": _found(xy, visible, right, truth, points),
    }
    return {"track_median_px": median, **alive}, more


def _found(xy: ndarray, visible: ndarray, right: ndarray, truth: Truth, points: Any, age: int = 60) -> float | None:
    kept = []
    for i, query in enumerate(points["query_frame"]):
        if query + age >= visible.shape[1] or not (points["visible"][[query, query + age], i]).all():
            continue
        distance = np.linalg.norm(xy[:, query] - points["uv"][query, i], axis=-1)
        same = truth.body(np.full(len(xy), query), xy[:, query]) == points["body"][i]
        distance = np.where(visible[:, query] & same, distance, np.inf)
        nearest = int(distance.argmin()) if len(xy) else -1
        kept.append(nearest >= 0 and distance[nearest] < NEAR_PX and right[nearest, query + age])
    return round(float(np.mean(kept)), 3) if kept else None


def abs_rel(depth: ndarray, truth: ndarray, where: ndarray | None = None) -> float:
    known = truth > 0 if where is None else where & (truth > 0)
    return round(float((np.abs(depth - truth)[known] / truth[known]).mean()), 4)


def _true_plane(view: View, instances: torch.Tensor, truth: Truth) -> dict[str, Any]:
    """The plane route with the true camera."""
    pose = truth.world_from_camera[0]
    height, tilt = float(pose[2, 3]) - truth.table_z, math.degrees(math.asin(-pose[2, 2]))
    intrinsics = torch.from_numpy(truth.intrinsics).float()
    bare_table = table_plane(view.camera.width, view.camera.height, intrinsics, height, tilt)
    standing, bare = with_standing(bare_table, instances).numpy(), bare_table.numpy()[None]
    return {
        "true cam": abs_rel(standing, truth.depth),
        "moving": abs_rel(standing, truth.depth, truth.moving),
        "bare": abs_rel(bare, truth.depth),
        "moving bare": abs_rel(bare, truth.depth, truth.moving),
    }


def timing() -> list[dict[str, Any]]:
    """Processor seconds per 100 frames of each provider on one synthetic episode."""
    rows = []
    for width, height in TIMED_SIZES:
        for frames in TIMED_FRAMES:
            scene = make_scene("all", 0, frames, width, height)
            truth = scene.render(scene.camera)
            start = time.process_time()
            median, noise = temporal_median(truth.rgb)
            instances = moving_instances(truth.rgb, median, noise)
            masks = time.process_time()
            flow_tracks(truth.rgb, instances)
            tracks = time.process_time()
            with_standing(table_plane(width, height, scene.camera.intrinsics[0], 0.5, 35.0), instances)
            plane = time.process_time()
            row = {"size": f"{width}x{height}", "frames": frames}
            for name, seconds in (("masks", masks - start), ("tracks", tracks - masks), ("plane", plane - tracks)):
                row[f"{name} s/100"] = round(100 * seconds / frames, 2)
            rows.append(row)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Rows with the same keys, in columns."""
    cells = [list(rows[0]), *([str(value) for value in row.values()] for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(cells[0]))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sim", type=Path, help="folder of scene folders")
    parser.add_argument("--scenes", help="some of them, separated by commas (default: all)")
    parser.add_argument("--json", type=Path, help="where to write the entries")
    parser.add_argument("--timing", action="store_true", help="time the providers on synthetic scenes")
    arguments = parser.parse_args()
    if not arguments.sim and not arguments.timing:
        parser.error("give --sim FOLDER, --timing, or both")
    if arguments.timing:
        sys.stdout.write(table(timing()) + "\n")
    if arguments.sim:
        every = sorted(path.parent.parent.name for path in arguments.sim.glob("*/gt/meta.json"))
        names = arguments.scenes.split(",") if arguments.scenes else every
        measured = [measure(arguments.sim, name) for name in names]
        sys.stdout.write(table([entry | more for entry, more in measured]) + "\n")
        if arguments.json:
            arguments.json.write_text(json.dumps([entry for entry, _ in measured], indent=1) + "\n")


if __name__ == "__main__":
    main()
