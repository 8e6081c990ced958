"""Novel views of DyCheck's iPhone sequences, by either of the two protocols; their numbers must not share a table.

`dycheck`: 2x pictures, the sequence's own cameras and masks (Gao et al. 2022). `som`: 1x pictures, with the cameras
and masks of Shape of Motion's package (Wang et al. 2025), which later papers follow.
"""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from numpy import ndarray

from lerobot_msdyn.evaluate.config import DycheckConfig
from lerobot_msdyn.evaluate.dycheck.iphone import IphoneSequence, read_sequence
from lerobot_msdyn.evaluate.dycheck.iphone_priors import read_priors
from lerobot_msdyn.evaluate.dycheck.same_world import in_world_of
from lerobot_msdyn.evaluate.metrics import masked_psnr_db, partial_ssim
from lerobot_msdyn.evaluate.perceptual import SpatialNetwork, lpips_network, masked_lpips, without_lpips
from lerobot_msdyn.evaluate.scores import Evaluated, Scores, mean_scores, score_table
from lerobot_msdyn.evaluate.timing import timed, timed_reconstruction
from lerobot_msdyn.priors.exchange import write_exchange
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.views.pictures import new_pictures

PRIORS_FILE = "priors.npz"


def evaluate_dycheck(config: DycheckConfig) -> Evaluated:
    """Fit camera 0 of a sequence, render all validation views to `out`, and score them, all by one protocol.

    Beside them, scores of the recorded picture of the same time, shown as it is.

    Raises:
        DatasetError: a file of the sequence is absent or not as expected.
        PriorError: a prior cannot be had.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "read"):
        sequence = read_sequence(config.root, config.protocol)
        _use_priors(config, sequence)
    scene = timed_reconstruction(seconds, sequence.view, config)
    with timed(seconds, "render"):
        rendered = render_validation(scene, sequence, config.out / "rgb")
        alone = render_validation(scene.without_overlay(), sequence)
    with timed(seconds, "score"):
        missing = without_lpips(config.lpips_weights)
        network = None if missing else lpips_network(config.lpips_weights)
        images, without = (
            {name: _score(sequence, name, picture, network) for name, picture in pictures.items()}
            for pictures in (rendered, alone)
        )
        shown = sequence.view.rgb.numpy()
        unchanged = [
            _score(sequence, name, shown[frame], network)
            for name, frame in zip(sequence.validation, sequence.frames, strict=True)
        ]
    empty = sum(math.isnan(scores["mpsnr"]) for scores in images.values())
    notices = [missing, f"{empty} of {len(images)} masks are empty: without mPSNR" if empty else ""]
    rows = {
        "this fit": mean_scores([*images.values()]),
        "this fit without overlay": mean_scores([*without.values()]),
        "recorded picture of that time": mean_scores(unchanged),
    }
    content: dict[str, Any] = {
        "sequence": config.root.name,
        "protocol": config.protocol,
        "mean": rows,
        "images": images,
        "what_moves": scene.account.entry(),
    }
    content |= {"seconds": seconds, "pictures": len(images), "notices": [notice for notice in notices if notice]}
    table = score_table(rows, f"{config.root.name}, protocol {config.protocol}")
    return Evaluated(content, table, config.out).written()


def render_validation(
    scene: Reconstruction, sequence: IphoneSequence, out: Path | None = None
) -> dict[str, UInt8[ndarray, "h w 3"]]:
    """The scene through the validation cameras, by picture; written to `out`, if there is one, as <id>.png."""
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    rendered = {}
    track = in_world_of(scene.camera, sequence.view.camera, sequence.cameras)
    cameras = np.array([name.split("_")[0] for name in sequence.validation])
    for camera in dict.fromkeys(cameras.tolist()):  # each stands still
        mine = np.flatnonzero(cameras == camera)
        frames = torch.tensor([sequence.frames[i] for i in mine])
        pictures = new_pictures(scene, track.select(mine.tolist()), frames)
        for i, picture in zip(mine.tolist(), pictures, strict=True):
            rendered[sequence.validation[i]] = picture.rgb
            if out is not None:
                cv2.imwrite(str(out / f"{sequence.validation[i]}.png"), picture.rgb[..., ::-1])
    return rendered


def _use_priors(config: DycheckConfig, sequence: IphoneSequence) -> None:
    """Takes from Shape of Motion's package what the recipe leaves to be chosen; it is kept in OUT/priors.npz."""
    if sequence.protocol != "som":
        return
    priors = read_priors(sequence, config.fit.max_width)
    wanted = {name: getattr(priors, name) is not None for name in ("masks", "depth", "tracks")}
    path = config.out / PRIORS_FILE
    write_exchange(path, priors)
    for name, there in wanted.items():
        if there and getattr(config.priors, name) == "auto":
            setattr(config.priors, name, str(path))


def _score(
    sequence: IphoneSequence, name: str, picture: UInt8[ndarray, "h w 3"], network: SpatialNetwork | None
) -> Scores:
    true, mask = sequence.true_picture(name), sequence.covisible(name)
    scores = {"mpsnr": masked_psnr_db(picture, true, mask), "mssim": partial_ssim(picture, true, mask)}
    if mask.sum() == 0:
        scores["mpsnr"] = math.nan
    return scores if network is None else scores | {"mlpips": masked_lpips(picture, true, mask, network)}
