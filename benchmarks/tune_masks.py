"""Finds the weights of the masks' test for change (`priors/masks/change.py`) by logistic regression.

    python benchmarks/tune_masks.py [--kinds push,lid,sheet,all] [--seeds 3,4] [--sim FOLDER --episodes NAME/epNN,...]

On synthetic videos (AV1, read as any dataset is) and, with --sim, on further episodes whose folders are laid out as
`benchmarks/priors.py` wants them; never on the scenes that docs/results.md reports. A pixel's features are its
difference to the true background of its video; those that belong to something that moves are told from the others,
shadows included. Every video counts the same, and so do its moving and its still pixels; the bias is then corrected for
how rare moving pixels are (prior correction). Prints the weights and, per video, the share of both that the test gets
right, at equal odds, when it is fitted to the other videos.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from priors import Truth

from lerobot_msdyn.core.config import CameraConfig
from lerobot_msdyn.dataset.read import open_source, read_episode
from lerobot_msdyn.priors.masks.change import Reference, to_lab
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset

KEY = "observation.images.front"
FRAMES, WIDTH, HEIGHT = 60, 320, 240
EVERY = 4  # frames
PIXELS = 4000  # of a kind and a video
RIM_PX = 1  # of a mask, where a pixel shows both
LEAST_STILL = 5  # frames in which a pixel must show the background to take part
NOISE_FLOOR = 1.0  # CIE Lab units, as in the masks
RIDGE = 1e-3  # of the regression
STEPS = 30  # Newton's

# Features of pixels; whether they belong to what moves; the share of all pixels that does.
Sample = tuple[Float[ndarray, "n f"], Bool[ndarray, " n"], float]


def synthetic(kind: str, seed: int) -> tuple[UInt8[ndarray, "t h w 3"], Bool[ndarray, "t h w"]]:
    """A synthetic video as it is read from its AV1 file, and what truly moves in it."""
    scene = make_scene(kind, seed, FRAMES, WIDTH, HEIGHT)
    with tempfile.TemporaryDirectory() as folder:
        write_dataset([scene], "local/masks", Path(folder) / "masks", cameras=["front"])
        return _video(Path(folder) / "masks", 0), scene.render(scene.camera).instances.numpy() > 0


def simulated(folder: Path, name: str) -> tuple[UInt8[ndarray, "t h w 3"], Bool[ndarray, "t h w"]]:
    """An episode of a simulated dataset, and what truly moves in it."""
    scene, _, part = name.partition("/")
    moving = Truth.read(folder / scene / "gt" / part).moving
    return _video(folder / scene / "dataset", int(part.removeprefix("ep") or 0)), moving


def _video(root: Path, episode: int) -> UInt8[ndarray, "t h w 3"]:
    source = open_source(f"local/{root.name}", root)
    return read_episode(source, episode, [KEY], CameraConfig(), recorded_depth=False).views[KEY].rgb.numpy()


def sampled(rgb: UInt8[ndarray, "t h w 3"], moving: Bool[ndarray, "t h w"]) -> Sample:
    """Features of as many moving as still pixels of a video."""
    still = ~moving
    known = still.sum(0) >= LEAST_STILL
    frames = np.ma.array(rgb, mask=np.repeat(moving[..., None], 3, axis=-1))
    background = np.ma.median(frames, axis=0).filled(0).astype(np.uint8)
    distance = np.linalg.norm(np.stack([to_lab(frame) for frame in rgb]) - to_lab(background), axis=-1)
    noise = np.ma.median(np.ma.array(distance, mask=moving), axis=0).filled(NOISE_FLOOR)
    reference = Reference(background, noise.clip(min=NOISE_FLOOR).astype(np.float32))
    window, rng = np.ones((2 * RIM_PX + 1,) * 2, np.uint8), np.random.default_rng(0)
    features: dict[bool, list[ndarray]] = {True: [], False: []}
    for frame in range(0, len(rgb), EVERY):
        values = np.stack(reference.features(rgb[frame]), axis=-1)
        mask = moving[frame].astype(np.uint8)
        features[True].append(values[(cv2.erode(mask, window) > 0) & known])
        features[False].append(values[(cv2.dilate(mask, window) == 0) & known])
    parts = {kind: np.concatenate(rows) for kind, rows in features.items()}
    parts = {kind: rows[rng.permutation(len(rows))[:PIXELS]] for kind, rows in parts.items()}
    labels = np.repeat([True, False], [len(parts[True]), len(parts[False])])
    return np.concatenate((parts[True], parts[False])), labels, float(moving.mean())


def fitted(samples: list[Sample]) -> Float[ndarray, " f"]:
    """Weights, and the bias behind them, of a logistic regression in which every video and kind counts the same."""
    x = np.concatenate([features for features, _, _ in samples]).astype(np.float64)
    x = np.concatenate((x, np.ones((len(x), 1))), axis=1)
    y = np.concatenate([moving for _, moving, _ in samples])
    weight = np.concatenate([np.where(m, 0.5 / m.sum(), 0.5 / (~m).sum()) for _, m, _ in samples]) / len(samples)
    beta = np.zeros(x.shape[1])
    ridge = RIDGE * np.eye(len(beta))
    for _ in range(STEPS):
        p = 1 / (1 + np.exp(-x @ beta))
        gradient = x.T @ (weight * (p - y)) + ridge @ beta
        beta -= np.linalg.solve((x * (weight * p * (1 - p))[:, None]).T @ x + ridge, gradient)
    return beta


def right(beta: Float[ndarray, " f"], sample: Sample) -> tuple[float, float]:
    """Shares of the still and of the moving pixels that weights get right."""
    features, moving, _ = sample
    positive = features @ beta[:-1] + beta[-1] > 0
    return float((~positive[~moving]).mean()), float(positive[moving].mean())


def videos(options: argparse.Namespace) -> Iterator[tuple[str, Sample]]:
    """Name and sample of every video."""
    for kind in options.kinds.split(","):
        for seed in options.seeds.split(","):
            yield f"{kind} {seed}", sampled(*synthetic(kind, int(seed)))
    for name in options.episodes.split(",") if options.sim else ():
        yield name, sampled(*simulated(options.sim, name))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default="push,lid,sheet,all", help="of synthetic scenes")
    parser.add_argument("--seeds", default="3,4")
    parser.add_argument("--sim", type=Path, help="folder of simulated datasets with truth")
    parser.add_argument("--episodes", default="pick_place_10/ep00,pick_place_10/ep05")
    named = dict(videos(parser.parse_args()))
    samples = list(named.values())
    sys.stdout.write("video                  still right   moving right\n")
    for number, (name, sample) in enumerate(named.items()):
        still, moving = right(fitted(samples[:number] + samples[number + 1 :]), sample)
        sys.stdout.write(f"{name:22s} {100 * still:8.1f} %   {100 * moving:10.1f} %\n")
    *weights, bias = fitted(samples)
    share = float(np.mean([moving for _, _, moving in samples]))
    bias += np.log(share / (1 - share))
    rounded = tuple(round(float(value), 2) for value in weights)
    sys.stdout.write(f"{100 * share:.1f} % of the pixels move; weights {rounded}, bias {bias:.2f}\n")


if __name__ == "__main__":
    main()
