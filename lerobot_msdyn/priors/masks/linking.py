"""Moving pixels as numbered things: linked over time by optical flow and overlap."""

import cv2
import numpy as np
from jaxtyping import Bool, Int, UInt8
from numpy import ndarray

from lerobot_msdyn.core.images import nearest_of

MAX_INSTANCES = 8
_MIN_INSTANCE_AREA = 1e-3  # of the image, while it is seen; smaller instances are dropped
_MIN_LIFE = 5  # frames; instances seen in fewer are dropped


def numbered(frames: UInt8[ndarray, "t h w 3"], moving: Bool[ndarray, "t h w"]) -> UInt8[ndarray, "t h w"]:
    """0 = static, 1, 2, ... = the things that move, the largest first; at most 8."""
    return _number(_linked(frames, moving))


def _linked(frames: UInt8[ndarray, "t h w 3"], moving: Bool[ndarray, "t h w"]) -> Int[ndarray, "t h w"]:
    """A number per moving thing, carried from frame to frame by optical flow; what flow does not reach is new."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    y, x = np.mgrid[: grey[0].shape[0], : grey[0].shape[1]].astype(np.float32)
    labels = np.zeros(moving.shape, np.int32)
    used = 0
    for t, mask in enumerate(moving):
        carried = np.zeros_like(labels[0])
        if t > 0 and labels[t - 1].any():
            flow = dis.calc(grey[t], grey[t - 1], None)
            last = labels[t - 1].astype(np.float32)
            carried = cv2.remap(last, x + flow[..., 0], y + flow[..., 1], cv2.INTER_NEAREST).astype(np.int32)
        count, components = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
        for component in range(1, count):
            inside = components == component
            before = carried * inside
            if before.any():
                labels[t][inside] = before.ravel()[nearest_of(before > 0)[inside]]
            else:
                used += 1
                labels[t][inside] = used
    return labels


def _number(labels: Int[ndarray, "t h w"]) -> UInt8[ndarray, "t h w"]:
    """The largest things as 1, 2, ...; what is small or short-lived is dropped."""
    area = np.stack([np.bincount(frame.ravel(), minlength=labels.max() + 1) for frame in labels])
    area[:, 0] = 0
    life = (area > 0).sum(0)
    lasting = (life >= min(_MIN_LIFE, len(labels))) & (
        area.sum(0) >= _MIN_INSTANCE_AREA * labels[0].size * np.maximum(life, 1)
    )
    order = np.argsort(-area.sum(0) * lasting, kind="stable")[: min(MAX_INSTANCES, int(lasting.sum()))]
    lookup = np.zeros(labels.max() + 1, np.uint8)
    lookup[order] = np.arange(1, len(order) + 1)
    return lookup[labels]
