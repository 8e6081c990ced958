"""How true new views are: the product's pictures, and a plane homography's, against exact ones of the same poses."""

import json
from collections.abc import Iterator

import cv2
import numpy as np

from lerobot_msdyn.dataset.provenance import read_provenance

from .cameras import Placement, intrinsics, product_pose, table_homography
from .sets import FRONT, RECORDED, ROWS, Row, Sets, front_pictures, opened

EPISODES = 5  # every so many recorded ones are looked at ...
SHARES = (0.25, 0.5, 0.95)  # ... at these parts of their length
HOMOGRAPHY = "homography at the same poses"


def fidelity(sets: Sets, names: list[str]) -> dict[str, dict[str, float]]:
    """PSNR (dB; means over pictures) over all pixels and over robot and block, by row of the product."""
    found: dict[str, dict[str, float]] = {}
    for name in names:
        own, warped = zip(*_errors(sets, ROWS[name]), strict=True)
        found[name] = _means(own)
        found[f"{name}: {HOMOGRAPHY}"] = _means(warped)
    return found


def text(found: dict[str, dict[str, float]]) -> str:
    """As a table."""
    rows = [f"| {name} | {value['all']:.2f} | {value['moving']:.2f} |" for name, value in found.items()]
    return "\n".join(["| pictures | PSNR, dB | robot and block |", "|---|---|---|", *rows])


def _errors(sets: Sets, row: Row) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """Of some pictures, mean square errors over all pixels and over what moves: the row's, and the homography's."""
    demonstrations, base = sets.demonstrations(), Placement().world_from_camera()
    new, recorded = opened(sets.folder(row)), opened(sets.folder(ROWS[RECORDED]))
    K, size = intrinsics(sets.form.width, sets.form.height), (sets.form.width, sets.form.height)
    for episode, origin in enumerate(read_provenance(new.root) or []):
        source = origin["source_episode"]
        if origin["variant"] < 0 or source % EPISODES:
            continue
        view, amounts = (json.loads(origin[column])[FRONT] for column in ("views", "perturbation"))
        pose = product_pose(view, amounts)
        H = table_homography(base, pose, K)
        before, after = front_pictures(recorded, source), front_pictures(new, episode)
        for t in (int(share * len(after)) for share in SHARES):
            exact = sets.scene.pictures(demonstrations[source].qpos[t], pose)[0].astype(np.float32)
            moving = sets.scene.moving()
            warped = cv2.warpPerspective(before[t], H, size, borderMode=cv2.BORDER_REPLICATE)
            yield _error(after[t], exact, moving), _error(warped, exact, moving)


def _error(picture: np.ndarray, exact: np.ndarray, moving: np.ndarray) -> tuple[float, float]:
    squares = (picture.astype(np.float32) - exact) ** 2
    return float(squares.mean()), float(squares[moving].mean())


def _means(errors: tuple[tuple[float, float], ...]) -> dict[str, float]:
    decibel = 10 * np.log10(255**2 / np.array(errors))
    return dict(zip(("all", "moving"), decibel.mean(0).round(2).tolist(), strict=True))
