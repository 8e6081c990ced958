"""Segment Anything (Kirillov et al., ICCV 2023) and its like, as two files of ONNX: an encoder of pictures, and a
decoder that is shown a box, points and a rough mask and answers with the thing that is meant.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from lerobot_msdyn.core.errors import PriorError, first_line
from lerobot_msdyn.priors.onnx_file import (
    IMAGENET,
    NETWORK_SUFFIX,
    PictureSpec,
    check_names,
    decoded,
    load_session,
    read_yaml,
)

SPEC = "sam.yaml"  # in the folder

_EMBEDDING, _POINTS, _LABELS, _MASK, _HAS_MASK, _SIZE = (  # of the decoder, as Segment Anything exports it
    "image_embeddings",
    "point_coords",
    "point_labels",
    "mask_input",
    "has_mask_input",
    "orig_im_size",
)
_TAKEN = {_EMBEDDING, _POINTS, _LABELS, _MASK, _HAS_MASK, _SIZE}
_LOGITS, _QUALITY = "low_res_masks", "iou_predictions"
_INSIDE, _TOP_LEFT, _BOTTOM_RIGHT, _NO_BOX = 1, 2, 3, -1  # labels of points
_SURE = 20.0  # logit, of a mask that is shown
_POINTS_SHOWN = 3


@dataclass
class SamSpec(PictureSpec):
    """What an encoder takes; as Segment Anything does where nothing else is stated."""

    mean: list[float] = field(default_factory=lambda: list(IMAGENET["mean"]))
    std: list[float] = field(default_factory=lambda: list(IMAGENET["std"]))


def read_sam_spec(folder: Path) -> SamSpec:
    """What `sam.yaml` states.

    Raises:
        PriorError: it states something unknown or of the wrong type.
    """
    path = folder / SPEC
    stated = read_yaml(path)
    check_names(path, stated, SamSpec)
    return decoded(SamSpec, stated, str(path))


def network_files(folder: Path) -> list[Path]:
    """The files of ONNX in a folder."""
    return sorted(folder.glob(f"*{NETWORK_SUFFIX}"))


class SamNetworks:
    """An encoder and a decoder."""

    def __init__(self, folder: Path, device: str) -> None:
        """Load them; which is which is told by what they take.

        Args:
            folder: holds both, and `sam.yaml` where colours are not as Segment Anything takes them.
            device: cpu, or cuda where onnxruntime was built with it.

        Raises:
            PriorError: the folder does not hold an encoder and a decoder.
        """
        self._folder, self.spec = folder, read_sam_spec(folder)
        sessions = [load_session(file, device) for file in network_files(folder)]
        takes = [{each.name: each for each in session.get_inputs()} for session in sessions]
        encoders = [session for session, taken in zip(sessions, takes, strict=True) if len(taken) == 1]
        decoders = [session for session, taken in zip(sessions, takes, strict=True) if set(taken) == _TAKEN]
        if len(sessions) != 2 or len(encoders) != 1 or len(decoders) != 1:
            found = "; ".join(f"one that takes {', '.join(sorted(taken))}" for taken in takes) or "none"
            raise PriorError(
                f"{folder} holds networks: {found}; expected two, an encoder that takes a picture and a decoder that "
                f"takes {', '.join(sorted(_TAKEN))}"
            )
        self._encoder, self._decoder = encoders[0], decoders[0]
        self._picture = self._encoder.get_inputs()[0].name
        self._side = self._square(self._encoder.get_inputs()[0], 3)
        self._mask_side = self._square(next(each for each in self._decoder.get_inputs() if each.name == _MASK), 1)

    def encoded(self, frame: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "1 c eh ew"]:
        """What the decoder needs of a frame, which is scaled to the encoder's size and padded below or at the right."""
        normal = self.spec.normal(_scaled(frame, self._side))
        padded = np.zeros((1, 3, self._side, self._side), np.float32)
        padded[0, :, : normal.shape[0], : normal.shape[1]] = normal.transpose(2, 0, 1)
        (embedding,) = self._run(self._encoder, None, {self._picture: padded})[:1]
        return embedding

    def answer(
        self, embedding: Float32[ndarray, "1 c eh ew"], mask: Bool[ndarray, "h w"], *, whole: bool = False
    ) -> Float32[ndarray, "h w"]:
        """Logits of the thing that is meant by a mask, of which at least one pixel is inside.

        Args:
            embedding: of the frame.
            mask: shown by points inside, and by its box and itself.
            whole: shown by points alone, so that the answer may be larger than the mask.
        """
        points = _points_inside(mask, _POINTS_SHOWN + 2 * whole)
        labels = [_INSIDE] * len(points)
        rough = np.zeros((1, 1, self._mask_side, self._mask_side), np.float32)
        if whole:
            points, labels = [*points, (0.0, 0.0)], [*labels, _NO_BOX]
        else:
            points, labels = [*_corners(mask), *points], [_TOP_LEFT, _BOTTOM_RIGHT, *labels]
            small = _scaled(mask.astype(np.float32), self._mask_side)
            rough[:] = -_SURE
            rough[0, 0, : small.shape[0], : small.shape[1]] = _SURE * (2 * small - 1)
        height, width = mask.shape
        shown = {
            _EMBEDDING: embedding,
            _POINTS: np.array([points], np.float32) * np.float32(self._side / max(height, width)),
            _LABELS: np.array([labels], np.float32),
            _MASK: rough,
            _HAS_MASK: np.array([not whole], np.float32),
            _SIZE: np.array([height, width], np.float32),
        }
        logits, quality = self._run(self._decoder, [_LOGITS, _QUALITY], shown)
        best = logits[0, int(quality[0].argmax())]
        scale = best.shape[0] / max(height, width)
        inside = np.ascontiguousarray(best[: round(height * scale), : round(width * scale)])
        return cv2.resize(inside, (width, height), interpolation=cv2.INTER_LINEAR)

    def _square(self, taken: Any, channels: int) -> int:
        """Side of a square input with so many channels."""
        _, depth, height, width = taken.shape if len(taken.shape) == 4 else (None,) * 4
        if depth != channels or not isinstance(height, int) or height != width:
            raise PriorError(
                f"{self._folder} takes {taken.name} of shape {taken.shape}; expected [1, {channels}, side, side]"
            )
        return height

    def _run(self, session: Any, names: list[str] | None, given: dict[str, ndarray]) -> list[ndarray]:
        try:
            return [np.asarray(each) for each in session.run(names, given)]
        except Exception as error:  # onnxruntime's own kinds have no base but this
            raise PriorError(f"the networks in {self._folder} cannot be run ({first_line(error)})") from error


def _scaled(image: ndarray, side: int) -> ndarray:
    """An image whose longer side is so long."""
    height, width = image.shape[:2]
    scale = side / max(height, width)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return cv2.resize(image, (round(width * scale), round(height * scale)), interpolation=how)


def _corners(mask: Bool[ndarray, "h w"]) -> list[tuple[float, float]]:
    """x, y of the upper left and the lower right corner of a mask's box."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return [(float(columns[0]), float(rows[0])), (float(columns[-1] + 1), float(rows[-1] + 1))]


def _points_inside(mask: Bool[ndarray, "h w"], most: int) -> list[tuple[float, float]]:
    """x, y of the pixel that is deepest inside a mask, and of others that are deep and far from those before."""
    depth = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    rows, columns = np.indices(mask.shape)
    apart = np.ones(mask.shape, np.float32)
    points: list[tuple[float, float]] = []
    while len(points) < most:
        row, column = divmod(int((depth * np.sqrt(apart)).argmax()), mask.shape[1])
        away = np.hypot(rows - row, columns - column).astype(np.float32)
        apart = away if not points else np.minimum(apart, away)
        points.append((column + 0.5, row + 0.5))
        if not (depth * apart).any():
            break
    return points
