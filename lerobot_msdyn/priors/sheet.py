"""A contact sheet of a video's priors, because people would rather look."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8
from numpy import ndarray

from lerobot_msdyn.core.observations import PointTracks, Priors, View
from lerobot_msdyn.core.sampling import evenly

_CELL_WIDTH = 320  # px
_GAP, _LINE = 4, 22  # px: between pictures, and of a line of text
_TAIL_S = 0.5  # length of the tracks' tails
_MAX_TRACKS = 200  # shown per instance: more would hide the image
_DIM = 0.45  # brightness of the picture behind tracks and masks
_WHITE, _INK, _UNKNOWN = (255, 255, 255), (30, 30, 30), (90, 90, 90)
# Colours of the instances, told apart also with the commonest colour-blindness (Okabe and Ito), RGB.
PALETTE = np.array(
    [
        (230, 159, 0),
        (86, 180, 233),
        (0, 158, 115),
        (240, 228, 66),
        (0, 114, 178),
        (213, 94, 0),
        (204, 121, 167),
        (170, 170, 170),
    ],
    np.uint8,
)


def contact_sheet(
    videos: Sequence[tuple[str, View, Priors]], fps: int | float, columns: int
) -> UInt8[ndarray, "_ _ 3"]:
    """Per camera (name, video, priors) four rows, over evenly spread frames: picture, instances, depth, tracks."""
    blocks = [_block(name, view, priors, fps, columns) for name, view, priors in videos]
    width = max(block.shape[1] for block in blocks)
    padded = [
        cv2.copyMakeBorder(block, 0, 3 * _GAP, 0, width - block.shape[1], cv2.BORDER_CONSTANT, value=_WHITE)
        for block in blocks
    ]
    return np.concatenate(padded)


def _block(name: str, view: View, priors: Priors, fps: int | float, columns: int) -> UInt8[ndarray, "_ _ 3"]:
    frames = evenly(len(view), columns).tolist()
    rgb = view.rgb.numpy()
    near, far = depth_range(priors)
    tail = max(1, round(_TAIL_S * fps))
    instances = f"{int(priors.instances.max())} instances"
    rows: list[tuple[str, list[UInt8[ndarray, "_ _ 3"]]]] = [
        (f"{name}, {rgb.shape[2]}x{rgb.shape[1]}, {len(rgb)} frames", [rgb[t] for t in frames]),
        (
            _head(priors, "masks", instances),
            [_instances(rgb[t], priors, t) for t in frames],
        ),
        (
            _head(priors, "depth", f"red {near:.2f} m, blue {far:.2f} m, grey unknown"),
            [coloured_depth(priors.depth[t].numpy(), near, far) for t in frames],
        ),
        (
            _head(priors, "tracks", f"{len(priors.tracks)} tracks, tails of {_TAIL_S:g} s, ring = just lost"),
            [_tracks(rgb[t], priors.tracks, t, tail) for t in frames],
        ),
    ]
    strips = [_strip(text, pictures) for text, pictures in rows]
    for i, t in enumerate(frames):
        place = (i * (_CELL_WIDTH + _GAP) + 5, strips[0].shape[0] - _GAP - 6)
        for thickness, colour in ((3, _INK), (1, _WHITE)):
            text = f"{t / fps:.1f} s, frame {t}"
            cv2.putText(strips[0], text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness, cv2.LINE_AA)
    return np.concatenate(strips)


def _head(priors: Priors, prior: str, more: str) -> str:
    """The head of a row: where it comes from, and more."""
    entry = priors.provenance.get(prior, {})
    model = f" {entry['model']}" if "model" in entry else ""
    return f"{prior}: {entry.get('provider', '')}{model}; {more}"


def _strip(text: str, pictures: list[UInt8[ndarray, "_ _ 3"]]) -> UInt8[ndarray, "h w 3"]:
    """Pictures side by side at a common width, under a line of text."""
    height = round(_CELL_WIDTH * pictures[0].shape[0] / pictures[0].shape[1])
    cells = []
    for picture in pictures:
        shrinks = picture.shape[1] > _CELL_WIDTH
        method = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
        cell = cv2.resize(picture, (_CELL_WIDTH, height), interpolation=method)
        cells.append(cv2.copyMakeBorder(cell, 0, _GAP, 0, _GAP, cv2.BORDER_CONSTANT, value=_WHITE))
    body = np.concatenate(cells, axis=1)
    line = np.full((_LINE, body.shape[1], 3), 255, np.uint8)
    cv2.putText(line, text, (4, _LINE - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)
    return np.concatenate((line, body))


def _instances(rgb: UInt8[ndarray, "h w 3"], priors: Priors, frame: int) -> UInt8[ndarray, "h w 3"]:
    """The picture, dimmed, each instance in its colour with an outline."""
    instances = priors.instances[frame].numpy()
    out = (_DIM * rgb).astype(np.uint8)
    for number in np.unique(instances[instances > 0]):
        mask = instances == number
        colour = PALETTE[(int(number) - 1) % len(PALETTE)]
        out[mask] = (0.4 * rgb[mask] + 0.6 * colour).astype(np.uint8)
        outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(out, outlines, -1, colour.tolist(), 1)
    return out


def depth_range(priors: Priors) -> tuple[float, float]:
    """Near and far end (m) of the colour map: 2 and 98 % of the known depths of the clip."""
    depth = priors.depth.numpy()
    known = depth[depth > 0]
    if len(known) == 0:
        return 0.1, 1.0
    near, far = np.percentile(known[:: max(1, len(known) // 100_000)], (2, 98))
    return float(near), float(max(far, 1.01 * near))


def coloured_depth(depth: Float32[ndarray, "h w"], near: float, far: float) -> UInt8[ndarray, "h w 3"]:
    """Inverse depth in colours, red = near, blue = far; grey where depth is unknown."""
    inverse = 1 / np.maximum(depth, 1e-6)
    nearness = ((inverse - 1 / far) / (1 / near - 1 / far)).clip(0, 1)
    coloured = cv2.applyColorMap((255 * nearness).round().astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    coloured[depth <= 0] = _UNKNOWN
    return coloured


def _tracks(rgb: UInt8[ndarray, "h w 3"], tracks: PointTracks, frame: int, tail: int) -> UInt8[ndarray, "H W 3"]:
    """The picture, dimmed; dots where points are seen, lines where they were, rings where they were just lost."""
    scale = max(1, round(2 * _CELL_WIDTH / rgb.shape[1]))  # thin lines need pixels
    out = cv2.resize((_DIM * rgb).astype(np.uint8), None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    xy, visible = tracks.xy.numpy() * scale, tracks.visible.numpy()
    for row in _shown(tracks.instance.numpy()):
        colour = PALETTE[(int(tracks.instance[row]) - 1) % len(PALETTE)].tolist()
        first = max(0, frame - tail)
        seen = np.nonzero(visible[row, first : frame + 1])[0] + first
        if len(seen) == 0:
            continue
        line = np.rint(8 * (xy[row, seen] - 0.5)).astype(np.int32)  # in eighths of a pixel
        cv2.polylines(out, [line], False, colour, 1, cv2.LINE_AA, shift=3)
        ring = 1 if seen[-1] < frame else -1
        cv2.circle(out, tuple(line[-1].tolist()), 8 * (3 if ring == 1 else 2), colour, ring, cv2.LINE_AA, shift=3)
    return out


def _shown(instance: Int[ndarray, " n"]) -> list[int]:
    """Rows of an even selection of each instance's tracks."""
    rows: list[int] = []
    for number in np.unique(instance):
        of_instance = np.nonzero(instance == number)[0]
        rows += of_instance[:: -(-len(of_instance) // _MAX_TRACKS)].tolist()
    return rows
