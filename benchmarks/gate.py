"""What the gate's score says of a view against what the view is, on simulated episodes with true held-out views.

    python benchmarks/gate.py --sim FOLDER [--scenes A,B] [--json FILE]

FOLDER holds one folder per scene with dataset_depth/ and gt/ (docs/evaluate.md). Every scene is reconstructed from
good priors and in five bad ways (corruptions.py); every reconstruction is rendered from all held-out cameras.
One case is one scene, corruption and camera. Printed, and written to FILE:

    cases                 how many
    spearman              rank correlation of the gate's episode score and the true PSNR over what was seen
    caught_share          share of the views under 20 dB that are among the fifth with the worst scores
    coverage_error_points mean difference of the predicted and the true covered share, in points of percent
    flicker_ratio         flicker of what stands still, rendered against recorded, mean over uncorrupted reconstructions

To be affordable, every third frame is used, 160 px wide, with 40 steps and rigid parts (--stride, --width, --steps).
"""

import argparse
import json
import logging
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np
import torch
from corruptions import CORRUPTIONS, clean_priors, corrupted, read_clip

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.reconstruction.account import decibels
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.views.gate import judge
from lerobot_msdyn.views.pictures import new_pictures

BAD_DB = 20.0
WORST_SHARE = 0.2


@dataclass(frozen=True)
class Row:
    """One case."""

    scene: str
    corruption: str
    camera: str
    score_db: float
    true_db: float
    covered: float
    truly_covered: float
    flicker_ratio: float


def main(arguments: list[str]) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sim", type=Path, required=True)
    parser.add_argument("--scenes", help="default: all that are in the folder")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--stride", type=int, default=3, help="every so many frames")
    parser.add_argument("--width", type=int, default=160, help="px")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--corruptions", default=",".join(CORRUPTIONS))
    a = parser.parse_args(arguments)
    logging.disable(logging.WARNING)
    scenes = a.scenes.split(",") if a.scenes else sorted(p.parent.name for p in a.sim.glob("*/dataset_depth"))
    rows: list[Row] = []
    for scene in scenes:
        rows += measure(a.sim / scene, a.corruptions.split(","), a.stride, a.width, a.steps)
    figures = summary(rows)
    print(json.dumps(figures))
    if a.json:
        a.json.write_text(json.dumps(figures | {"rows": [asdict(row) for row in rows]}, indent=1))


def measure(folder: Path, corruptions: list[str], stride: int, width: int, steps: int) -> list[Row]:
    """All cases of one scene."""
    recipe = Recipe()
    recipe.fit.steps, recipe.fit.max_width, recipe.priors.cache = steps, width, "off"
    recipe.motion.levels, recipe.motion.register = ["object"], False
    view = read_clip(folder, stride, width)
    clean = clean_priors(view, recipe)
    rows = []
    for corruption in corruptions:
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as place:
            case = corrupted(view, recipe, corruption, clean, Path(place))
            scene = reconstruct(case.view, case.recipe)
        made = [
            views(scene, folder, path, corruption, stride) for path in sorted((folder / "gt/heldout").glob("*.npz"))
        ]
        rows += made
        true = np.mean([row.true_db for row in made])
        score = np.mean([row.score_db for row in made])
        print(f"{folder.name:12s}{corruption:14s}true {true:5.1f} dB  score {score:5.1f} dB  "
              f"{time.perf_counter() - start:5.0f} s", flush=True)  # fmt: skip
    return rows


def views(scene: Reconstruction, folder: Path, path: Path, corruption: str, stride: int) -> Row:
    """One held-out camera: what the gate says of it, and what is true of it, at the frames that both have."""
    width, height = scene.camera.width, scene.camera.height
    with np.load(path, allow_pickle=False) as truth:
        chosen = [i for i, frame in enumerate(truth["frame"].tolist()) if frame % stride == 0]
        frames, poses = truth["frame"][chosen] // stride, torch.from_numpy(truth["c2w"][chosen]).float()
        seen = np.moveaxis(truth["covis"][..., chosen] > 0, -1, 0).astype(np.float32)
        intrinsics = torch.from_numpy(truth["K"]).float().expand(len(truth["frame"]), 3, 3)[chosen]
    full = CameraTrack(intrinsics.contiguous(), poses, seen.shape[2], seen.shape[1])
    with av.open(str(path.with_suffix(".mkv"))) as video:
        true = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    errors, covered = [], []
    rendered = new_pictures(scene, full.resized(width, height), torch.from_numpy(frames).long())
    for index, covered_part, picture in zip(chosen, seen, rendered, strict=True):
        inside = cv2.resize(covered_part, (width, height), interpolation=cv2.INTER_AREA) > 0.99
        goal = cv2.resize(true[index], (width, height), interpolation=cv2.INTER_AREA)
        difference = (picture.rgb.astype(np.float32) - goal) / 255
        errors.append(decibels(float(np.square(difference[inside]).mean())))
        covered.append(1 - float(picture.unseen.mean()))
    total = len(scene.camera)
    held_still = replace(
        full, intrinsics=full.intrinsics[:1].expand(total, 3, 3), world_from_camera=poses[:1].expand(total, 4, 4)
    )
    scores = judge(scene.windows, held_still)
    return Row(
        folder.name,
        corruption,
        path.stem,
        scores.expected_db,
        float(np.mean(errors)),
        float(np.mean(covered)),
        float(seen.mean()),
        scores.flicker_ratio,
    )


def summary(rows: list[Row]) -> dict[str, float]:
    """The figures over all cases; those of coverage and flicker over the uncorrupted ones."""
    score = np.array([row.score_db for row in rows])
    true = np.array([row.true_db for row in rows])
    worst = np.argsort(score)[: round(WORST_SHARE * len(rows))]
    bad = true < BAD_DB
    clean = [row for row in rows if row.corruption == "none"]
    return {
        "cases": len(rows),
        "spearman": round(spearman(score, true), 4),
        "caught_share": round(float(bad[worst].sum() / bad.sum()), 4) if bad.any() else 1.0,
        "bad_views": int(bad.sum()),
        "bias_db": round(float((score - true).mean()), 2),
        "coverage_error_points": round(100 * float(np.mean([abs(r.covered - r.truly_covered) for r in clean])), 2)
        if clean
        else float("nan"),
        "flicker_ratio": round(float(np.mean([row.flicker_ratio for row in clean])), 3) if clean else float("nan"),
    }


def spearman(one: np.ndarray, other: np.ndarray) -> float:
    """Rank correlation; ties are as good as absent between measured values."""
    ranks = [np.argsort(np.argsort(values)) for values in (one, other)]
    return float(np.corrcoef(ranks)[0, 1])


if __name__ == "__main__":
    main(sys.argv[1:])
