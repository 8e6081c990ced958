"""Outlines of what moves by a network that segments single pictures and is shown the weights-free masks.

On key frames each instance is shown to the network, which outlines it anew. What mostly rests (a thing that is moved,
other than the arm that moves it) is shown together with what was carried there, by optical flow, from the key frame in
which network and mask agree best: so it stays whole where the mask loses a part of it. An answer that contradicts the
mask is not taken. In the frames between, masks are corrected as they are on the key frames before and behind.
"""

import itertools
from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

_EVERY = 5  # frames from one key frame to the next
_LEAST_PX = 30  # pixels of an instance that is shown
_AGREES = 0.8  # IoU from which an answer may stand for the mask
_MOSTLY_RESTS = 0.8  # median IoU of an instance's masks in successive key frames, from which it is carried
_WHOLE = 0.5  # IoU of mask and answer to points alone, from which the outline is carried
_COVERS, _STAYS = 0.7, 0.7  # share of the mask that an answer must cover; its IoU with what was shown
_GROWS = (
    1.2  # times the first outline, over its IoU: where mask and network agree by half, it may become twice as large
)


@runtime_checkable
class Segmenter(Protocol):
    """As `sam_onnx.SamNetworks`."""

    def encoded(self, frame: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "1 c eh ew"]:
        """What `answer` needs of a frame."""

    def answer(
        self, embedding: Float32[ndarray, "1 c eh ew"], mask: Bool[ndarray, "h w"], *, whole: bool = False
    ) -> Float32[ndarray, "h w"]:
        """Logits of the thing that a mask means, or of the whole thing that it may be a part of."""


def refined(
    rgb: UInt8[ndarray, "t h w 3"], instances: UInt8[ndarray, "t h w"], network: Segmenter
) -> UInt8[ndarray, "t h w"]:
    """Instances with the network's outlines where these agree; their numbers stay."""
    numbers = np.unique(instances[instances > 0])
    out = instances.copy()
    if len(numbers) == 0:
        return out
    pictures = _KeyFrames(rgb, network)
    masks = np.stack([instances[pictures.frames] == number for number in numbers])
    corrections = np.stack([_outlines(pictures, its) for its in masks]).astype(np.float32) - masks
    for key, (first, last) in enumerate(itertools.pairwise(pictures.frames)):
        before = pictures.carried(corrections[:, key], range(first, last + 1))
        behind = [*pictures.carried(corrections[:, key + 1], range(last, first - 1, -1))][::-1]
        for step, (old, new) in enumerate(zip(before, behind, strict=True)):
            frame, share = first + step, step / (last - first)
            inside = (instances[frame] == numbers[:, None, None]) + (1 - share) * old + share * new
            out[frame] = np.where(inside.max(0) > 0.5, numbers[inside.argmax(0)], 0)
    return out


class _KeyFrames:
    """Every fifth frame of a video and its last: what the network says of them, and what flow carries between them."""

    def __init__(self, rgb: UInt8[ndarray, "t h w 3"], network: Segmenter) -> None:
        self.frames = [*range(0, len(rgb) - 1, _EVERY), len(rgb) - 1]
        self._grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in rgb]
        self._network = network
        self._embeddings = [network.encoded(rgb[frame]).astype(np.float16) for frame in self.frames]

    def answer(self, key: int, mask: Bool[ndarray, "h w"], *, whole: bool = False) -> Bool[ndarray, "h w"]:
        """What the network takes a mask for in a key frame."""
        return self._network.answer(self._embeddings[key].astype(np.float32), mask, whole=whole) > 0

    def carried(self, images: Float32[ndarray, "n h w"], frames: range) -> Iterator[Float32[ndarray, "n h w"]]:
        """Images of the first of neighbouring frames as each of them shows them, step by step by optical flow."""
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        y, x = np.indices(images.shape[1:], np.float32)
        yield images
        for source, target in itertools.pairwise(frames):
            if images.any():
                flow = dis.calc(self._grey[target], self._grey[source], None)
                place = x + flow[..., 0], y + flow[..., 1]
                images = np.stack([cv2.remap(image, *place, cv2.INTER_LINEAR) for image in images])
            yield images

    def carried_to(self, key: int, mask: Bool[ndarray, "h w"], source: int) -> Bool[ndarray, "h w"]:
        """A mask of one key frame in another."""
        step = 1 if key > source else -1
        frames = range(self.frames[source], self.frames[key] + step, step)
        *_, (image,) = self.carried(mask[None].astype(np.float32), frames)
        return image > 0.5


def _outlines(pictures: _KeyFrames, masks: Bool[ndarray, "k h w"]) -> Bool[ndarray, "k h w"]:
    """An instance's outline on each key frame: the network's, else the mask's."""
    shown = [key for key, mask in enumerate(masks) if mask.sum() >= _LEAST_PX]
    out = masks.copy()
    for key in shown:
        answer = pictures.answer(key, masks[key])
        if _iou(answer, masks[key]) >= _AGREES:
            out[key] = answer
    if not _rests(masks):
        return out
    agreement = {key: _iou(pictures.answer(key, masks[key], whole=True), masks[key]) for key in shown}
    start = max(shown, key=lambda key: agreement[key])
    if agreement[start] < _WHOLE:
        return out
    most = _GROWS / agreement[start] * out[start].sum()
    for way in (range(start, len(masks)), range(start, -1, -1)):
        for last, key in itertools.pairwise(way):
            seen = masks[key] | pictures.carried_to(key, out[last], last)
            answer = pictures.answer(key, seen) if seen.sum() >= _LEAST_PX else masks[key] & False
            covers = (answer & masks[key]).sum() >= _COVERS * masks[key].sum()
            if not covers or _iou(answer, seen) < _STAYS or answer.sum() > most:
                break
            out[key] = answer | masks[key]
    return out


def _rests(masks: Bool[ndarray, "k h w"]) -> bool:
    """Whether an instance's mask hardly changes between most of the key frames that show it."""
    seen = masks.sum((1, 2)) >= _LEAST_PX
    overlaps = [_iou(a, b) for a, b, both in zip(masks, masks[1:], seen[:-1] & seen[1:], strict=False) if both]
    return bool(overlaps) and float(np.median(overlaps)) >= _MOSTLY_RESTS


def _iou(one: Bool[ndarray, "h w"], other: Bool[ndarray, "h w"]) -> float:
    return float((one & other).sum() / max((one | other).sum(), 1))
