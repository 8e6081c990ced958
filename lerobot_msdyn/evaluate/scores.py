"""Scores of the drawn views of one camera against the true ones, and of several cameras together."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from lerobot_msdyn.core.files import write_whole
from lerobot_msdyn.evaluate.metrics import flicker, inside_ssim, masked_psnr_db
from lerobot_msdyn.evaluate.perceptual import masked_flip, without_flip

MIN_PIXELS = 40  # a frame with fewer of a kind is left out of that kind's mean
NEVER, ELSEWHEN, SEEN = 0, 1, 2  # of a pixel: by the recorded camera never, at another time only, at the same time
NAMES = {  # score -> its column
    "psnr": "PSNR",
    "ssim": "SSIM",
    "dyn_psnr": "moving PSNR",
    "dyn_ssim": "moving SSIM",
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
        lines = [*stages, *self.table.splitlines(), *self.content["notices"]]
        return (
            "\n".join([*lines, f"{self.content['pictures']} pictures and {SCORES_FILE} written to {self.out}"]) + "\n"
        )


def score_views(drawn: UInt8[ndarray, "n h w 3"], true: TrueViews) -> Scores:
    """Means over the frames of one camera that stands still; of a kind of pixels that no frame has enough of: none.

    psnr, ssim, flip: over what the recorded camera saw at any time; dyn_*: the moving part of it; dis_psnr: what it
    saw at other times only; flicker (levels of 0..255): over what stands still of what it saw.
    """
    frames: list[Scores] = []
    perceptual = without_flip() == ""
    for i, (picture, truth) in enumerate(zip(drawn, true.rgb, strict=True)):
        covered = true.seen[i] != NEVER
        kinds = {"": covered, "dis_": true.seen[i] == ELSEWHEN}
        if true.moving is not None:
            kinds["dyn_"] = covered & true.moving[i]
        enough = {kind: mask for kind, mask in kinds.items() if mask.sum() >= MIN_PIXELS}
        found = {f"{kind}psnr": masked_psnr_db(picture, truth, mask) for kind, mask in enough.items()}
        found |= {f"{kind}ssim": inside_ssim(picture, truth, mask) for kind, mask in enough.items() if kind != "dis_"}
        if perceptual and "" in enough:
            found["flip"] = masked_flip(picture, truth, covered)
        frames.append(found)
    still = true.seen != NEVER if true.moving is None else (true.seen != NEVER) & ~true.moving
    return mean_scores(frames) | {"flicker": flicker(drawn, true.rgb, still)}


def mean_scores(scores: list[Scores]) -> Scores:
    """The mean of each score over those that have it, in the order of the columns."""
    found = {name: [one[name] for one in scores if not math.isnan(one.get(name, math.nan))] for name in NAMES}
    return {name: float(np.mean(values)) for name, values in found.items() if values}


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
    return f"{value:.2f}" if "psnr" in name or name == "flicker" else f"{value:.3f}"


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 5) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
