"""Compiled look-ups of new views on a CPU."""

import math

from numpy import ndarray

from lerobot_msdyn.core.compiled import compiled


@compiled
def look_up(
    depth: ndarray,
    before: ndarray,
    maps: ndarray,
    offsets: ndarray,
    farthest: ndarray,
    most: ndarray,
    tolerance: float,
    still: ndarray,
) -> None:
    """Frames that show what stands still at the pixels whose depth has changed: `evidence.still_frames` of these.

    Args:
        depth: of a picture, [h, w], m.
        before: of another one of the same camera, [h, w], m; NaN: everything has changed.
        maps: from pixels (x, y, 1) of the picture at 1 m to (x z, y z, z) of each key view, [k, 3, 3].
        offsets: what is added to that times the depth, [k, 3].
        farthest: largest depth at each corner of a pixel of each key view, [k, H + 1, W + 1], m.
        most: the most frames there, [k, H + 1, W + 1].
        tolerance: share of a surface's depth by which a point may lie behind it.
        still: in, out: the frames at each pixel, [h, w].
    """
    keys, height, width = farthest.shape
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if z == before[row, column]:
                continue
            x, y = column + 0.5, row + 0.5
            still[row, column] = 0
            for key in range(keys):
                m, o = maps[key], offsets[key]
                ahead = z * (m[2, 0] * x + m[2, 1] * y + m[2, 2]) + o[2]
                if not ahead > 0:
                    continue
                across = (z * (m[0, 0] * x + m[0, 1] * y + m[0, 2]) + o[0]) / max(ahead, 1e-6)
                down = (z * (m[1, 0] * x + m[1, 1] * y + m[1, 2]) + o[1]) / max(ahead, 1e-6)
                if not (across >= 0 and down >= 0 and across < width - 1 and down < height - 1):
                    continue
                i, j = math.floor(down + 0.5), math.floor(across + 0.5)
                if ahead <= farthest[key, i, j] * (1 + tolerance):
                    still[row, column] = max(still[row, column], most[key, i, j])
