"""What LeRobot's trainer asks of a feature and older recorders left out, filled in as LeRobot itself writes it."""

from typing import Any

from lerobot_msdyn.dataset.checks import PICTURE_DTYPES, picture_size

AXES = ["height", "width", "channels"]
DEPTH_FLAG = "is_depth_map"
LEGACY_DEPTH_FLAG = "video.is_depth_map"


def completed(feature: dict[str, Any]) -> dict[str, Any]:
    """A checked feature of info.json, with `names`, and with depth marked where LeRobot's encoder settings look for it.

    `names` of pictures are their axes. What marks depth is `is_depth_map` in `info`; older datasets have
    `video.is_depth_map` there, or in `video_info`, together with the settings of the encoder.
    """
    feature = feature | {"names": feature.get("names")}
    if feature["dtype"] not in PICTURE_DTYPES:
        return feature
    names = feature["names"]
    if not isinstance(names, list | tuple) or len(names) != 3:
        shape = [int(side) for side in feature["shape"]]
        feature["names"] = list(AXES) if picture_size(feature) == tuple(shape) else [AXES[-1], *AXES[:-1]]
    info, legacy = feature.get("info") or {}, feature.get("video_info") or {}
    if not info.get(DEPTH_FLAG) and any(block.get(LEGACY_DEPTH_FLAG) for block in (info, legacy)):
        feature["info"] = legacy | info | {DEPTH_FLAG: True}
        del feature["info"][LEGACY_DEPTH_FLAG]
    return feature
