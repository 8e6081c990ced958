"""What convinces at a glance: a robot's links, drawn over the video by the camera that was found."""

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from lerobot_msdyn.robots.calibration.contours import Posed
from lerobot_msdyn.robots.calibration.search import Pose
from lerobot_msdyn.robots.description import Robot

SHOWN, COLUMNS = 6, 3  # frames
ENLARGED = 2


def links_over(
    robot: Robot, pose: Pose, pictures: UInt8[ndarray, "t h w 3"], values: Float64[ndarray, "t j"]
) -> UInt8[ndarray, "a b 3"]:
    """Some frames with the outlines of the links (RGB).

    Args:
        robot: its description.
        pose: of the camera.
        pictures: frames.
        values: of the movable joints in them (rad, m).
    """
    height, width = pictures.shape[1:3]
    size = (ENLARGED * width, ENLARGED * height)
    shown = np.linspace(0, len(pictures) - 1, SHOWN).astype(int)
    posed = Posed(robot, values[shown])
    drawn = []
    for k, frame in enumerate(shown):
        _, link = posed.drawn(k, pose, width, height)
        large = cv2.resize(pictures[frame], size, interpolation=cv2.INTER_CUBIC)
        for index in np.unique(link[link >= 0]):
            hue = np.array([[[int(index) * 53 % 180, 255, 255]]], np.uint8)
            colour = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].tolist()
            region = cv2.resize((link == index).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            outlines, _ = cv2.findContours(region, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(large, outlines, -1, colour, 1)
        drawn.append(large)
    rows = [np.concatenate(drawn[k : k + COLUMNS], axis=1) for k in range(0, SHOWN, COLUMNS)]
    return np.concatenate(rows)
