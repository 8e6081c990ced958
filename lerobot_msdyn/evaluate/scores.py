"""Scores of the rendered views of one camera against the true ones, and of several cameras together.

The moving pixels of a camera that was not fitted are those that truly show something that moves (of a calibrated rig:
those that its masks call moving), as far as the recorded camera has seen them. `dyn_psnr` is over them, of views as
they are rendered; `dyn_psnr_without_overlay` of views without overlays, `dyn_psnr_by_motion` without short-lived
Gaussians either; `by_*` is the share of them that each source renders (`scene.sources`), of all frames together.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.files import write_whole
from lerobot_msdyn.evaluate.metrics import flicker, inside_ssim, masked_psnr_db
from lerobot_msdyn.evaluate.perceptual import SpatialNetwork, masked_flip, masked_lpips, without_flip
from lerobot_msdyn.reconstruction.account import Account, account_line
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.scene.sources import MovingPixels, sources_of

BATCH = 8  # pictures that are rendered together
MIN_PIXELS = 40  # a frame with fewer of a kind is left out of that kind's mean
NEVER, ELSEWHEN, SEEN = 0, 1, 2  # of a pixel: by the recorded camera never, at another time only, at the same time
NAMES = {  # score -> its column
    "psnr": "PSNR",
    "ssim": "SSIM",
    "dyn_psnr": "dynamic PSNR",
    "dyn_psnr_without_overlay": "without overlay",
    "dyn_psnr_by_motion": "motion alone",
    "by_motion": "by motion",
    "by_short_lived": "by short-lived",
    "by_overlay": "by overlay",
    "by_background": "by background",
    "dyn_ssim": "dynamic SSIM",
    "dis_psnr": "disocc. PSNR",
    "flip": "FLIP",
    "flicker": "flicker",
    "mpsnr": "mPSNR",
    "mssim": "mSSIM",
    "mlpips": "mLPIPS",
}
SCORES_FILE = "scores.json"

Scores = dict[str, float]


@dataclass(frozen=True)
class TrueViews:
    """What a camera that was not fitted truly saw."""

    rgb: UInt8[ndarray, "n h w 3"]
    seen: UInt8[ndarray, "n h w"]  # NEVER, ELSEWHEN or SEEN
    moving: Bool[ndarray, "n h w"] | None = None  # where something moves; None: not known


@dataclass(frozen=True)
class Evaluated:
    """What an evaluation found, as it is written to OUT/scores.json, and its table."""

    content: dict[str, Any]  # seconds (stage -> s), notices (what is left out, and why), and what the evaluation adds
    table: str
    out: Path

    def written(self) -> "Evaluated":
        """The same, once it is on disk."""
        write_whole(self.out / SCORES_FILE, (json.dumps(_plain(self.content), indent=1) + "\n").encode())
        return self

    def text(self) -> str:
        """For the terminal."""
        stages = [f"{stage:28s}{value:8.1f} s" for stage, value in self.content["seconds"].items()]
        account = self.content.get("what_moves")
        recorded = [] if account is None else [f"recorded camera: {account_line(Account.from_entry(account))}"]
        lines = [*stages, *self.table.splitlines(), *recorded, *self.content["notices"]]
        return (
            "\n".join([*lines, f"{self.content['pictures']} pictures and {SCORES_FILE} written to {self.out}"]) + "\n"
        )


def score_views(rendered: UInt8[ndarray, "n h w 3"], true: TrueViews, lpips: SpatialNetwork | None = None) -> Scores:
    """Means over the frames of one camera that stands still; of a kind of pixels that no frame has enough of: none.

    psnr, ssim, flip, mlpips (with a network): over what the recorded camera saw at any time; dyn_*: the moving part of
    it; dis_psnr: what it saw at other times only; flicker (levels of 0..255): over what stands still of what it saw.
    """
    frames: list[Scores] = []
    perceptual = without_flip() == ""
    for i, (picture, truth) in enumerate(zip(rendered, true.rgb, strict=True)):
        covered = true.seen[i] != NEVER
        kinds = {"": covered, "dis_": true.seen[i] == ELSEWHEN}
        if true.moving is not None:
            kinds["dyn_"] = covered & true.moving[i]
        enough = {kind: mask for kind, mask in kinds.items() if mask.sum() >= MIN_PIXELS}
        scores = {f"{kind}psnr": masked_psnr_db(picture, truth, mask) for kind, mask in enough.items()}
        scores |= {f"{kind}ssim": inside_ssim(picture, truth, mask) for kind, mask in enough.items() if kind != "dis_"}
        if perceptual and "" in enough:
            scores["flip"] = masked_flip(picture, truth, covered)
        if lpips is not None and "" in enough:
            scores["mlpips"] = masked_lpips(picture, truth, covered, lpips)
        frames.append(scores)
    still = true.seen != NEVER if true.moving is None else (true.seen != NEVER) & ~true.moving
    return mean_scores(frames) | {"flicker": flicker(rendered, true.rgb, still)}


def dynamic_psnr_db(rendered: UInt8[ndarray, "n h w 3"], true: TrueViews) -> float:
    """The score `dyn_psnr` alone; NaN where it is not known what moves, or no frame has enough of it."""
    if true.moving is None:
        return math.nan
    masks = (true.seen != NEVER) & true.moving
    enough = [i for i, mask in enumerate(masks) if mask.sum() >= MIN_PIXELS]
    return float(np.mean([masked_psnr_db(rendered[i], true.rgb[i], masks[i]) for i in enough])) if enough else math.nan


def source_shares(scene: Reconstruction, camera: CameraTrack, frames: Int[Tensor, " n"], true: TrueViews) -> Scores:
    """The scores `by_*` of views at some frames of the episode, a pose each; none where nothing is known to move."""
    if true.moving is None:
        return {}
    moving = torch.from_numpy((true.seen != NEVER) & true.moving)
    counted = MovingPixels()
    for window, stretch in scene.stretches(frames):
        for part in torch.arange(len(frames))[stretch].split(BATCH):
            sources = sources_of(window.scene, camera.select(part), frames[part] - window.start)
            counted += sources.count(moving[part])
    return counted.shares if counted.total > 0 else {}


def mean_scores(scores: list[Scores]) -> Scores:
    """The mean of each score over those that have it, in the order of the columns."""
    values = {name: [one[name] for one in scores if not math.isnan(one.get(name, math.nan))] for name in NAMES}
    return {name: float(np.mean(each)) for name, each in values.items() if each}


def score_table(cameras: Mapping[str, Scores], first: str = "camera") -> str:
    """A Markdown table: a line per camera."""
    names = [name for name in NAMES if any(name in scores for scores in cameras.values())]
    lines = [f"| {first} | " + " | ".join(NAMES[name] for name in names) + " |", "|---" * (len(names) + 1) + "|"]
    for camera, scores in cameras.items():
        lines.append(f"| {camera} | " + " | ".join(_shown(name, scores.get(name, math.nan)) for name in names) + " |")
    return "\n".join(lines) + "\n"


def _shown(name: str, value: float) -> str:
    if math.isnan(value):
        return "-"
    if name.startswith("by_"):
        return f"{100 * value:.0f} %"
    return f"{value:.2f}" if "psnr" in name or name == "flicker" else f"{value:.3f}"


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 5) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
