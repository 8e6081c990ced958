"""Pictures for the report that only work on an episode can make: its priors, and a frame of a view that was dropped."""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import Fill
from lerobot_msdyn.core.files import write_whole
from lerobot_msdyn.priors.sheet import contact_sheet
from lerobot_msdyn.reconstruction.reconstruct import STEPS, Draft, Step
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.views.pictures import new_pictures

COLUMNS = 4  # moments of a sheet
JPEG_QUALITY = 80


def steps_with_sheet(path: Path, key: str, fps: int | float) -> dict[str, Step]:
    """The steps of a reconstruction, and one that draws the priors of the video's first window to `path`."""

    def draw(draft: Draft) -> None:
        if draft.before is None:
            write_jpeg(path, contact_sheet([(key, draft.view, draft.priors)], fps, COLUMNS))

    return STEPS | {"sheet": draw}


def write_frame(path: Path, scene: Reconstruction, camera: CameraTrack, fill: Fill) -> None:
    """The frame in the middle of a new view, which is not rendered otherwise."""
    middle = [len(camera) // 2]
    write_jpeg(path, next(new_pictures(scene, camera.select(middle), torch.tensor(middle), fill=fill)).rgb)


def write_jpeg(path: Path, picture: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture."""
    content = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    write_whole(path, content.tobytes())
