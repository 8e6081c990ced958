"""Where the front camera stands: level poses about a point on the table, and the plane homography between two of them.

World axes are MuJoCo's: z up, the table at z = 0. Camera axes are OpenCV's: right, down, ahead.
"""

from dataclasses import dataclass, field

import numpy as np

LOOK_AT_M = np.array([0.17, 0.0, 0.08])
DISTANCE_M = 0.62
ELEVATION_DEG = 38.0
FOVY_DEG = 42.0
Matrix = np.ndarray


@dataclass(frozen=True)
class Placement:
    """A level pose, as it differs from the recorded camera's."""

    azimuth_deg: float = 0.0  # about the vertical through the look-at point, to the camera's right
    elevation_deg: float = 0.0
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # along the new camera's right, down, ahead; not turned

    def world_from_camera(self) -> Matrix:
        """4x4, OpenCV axes."""
        azimuth, elevation = np.radians([self.azimuth_deg, ELEVATION_DEG + self.elevation_deg])
        away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        axes = np.stack([right, np.cross(-away, right), -away], axis=1)
        pose = np.eye(4)
        pose[:3, :3] = axes
        pose[:3, 3] = LOOK_AT_M + DISTANCE_M * away + axes @ np.array(self.shift_m)
        return pose


@dataclass(frozen=True)
class TestCamera:
    """A camera that policies are tested from, and the group whose mean is reported."""

    __test__ = False  # to pytest

    group: str
    placement: Placement = field(default_factory=Placement)


def _pair(name: str, azimuth_deg: float, elevation_deg: float = 0.0) -> dict[str, TestCamera]:
    size = azimuth_deg or elevation_deg
    return {
        f"{name} {sign * size:+g}": TestCamera(f"{name} {size:g}", Placement(sign * azimuth_deg, sign * elevation_deg))
        for sign in (-1, 1)
    }


CAMERAS: dict[str, TestCamera] = {
    "recorded": TestCamera("recorded"),
    **_pair("azimuth", 5.0),
    **_pair("azimuth", 10.0),
    **_pair("azimuth", 15.0),
    **_pair("azimuth", 20.0),
    **_pair("elevation", 0.0, 5.0),
    "left 5 cm": TestCamera("shift 5 cm", Placement(shift_m=(-0.05, 0.0, 0.0))),
    "right 5 cm": TestCamera("shift 5 cm", Placement(shift_m=(0.05, 0.0, 0.0))),
    "up 5 cm": TestCamera("shift 5 cm", Placement(shift_m=(0.0, -0.05, 0.0))),
    "down 5 cm": TestCamera("shift 5 cm", Placement(shift_m=(0.0, 0.05, 0.0))),
    "-30 degrees, left 0.1 m": TestCamera("30 degrees + 0.1 m", Placement(-30.0, 0.0, (-0.1, 0.0, 0.0))),
    "+30 degrees, right 0.1 m": TestCamera("30 degrees + 0.1 m", Placement(30.0, 0.0, (0.1, 0.0, 0.0))),
}


def random_placement(rng: np.random.Generator, azimuth_deg: float, elevation_deg: float, shift_m: float) -> Placement:
    """Uniform within +- the given bounds."""
    azimuth, elevation = rng.uniform(-1, 1, 2) * (azimuth_deg, elevation_deg)
    x, y, z = rng.uniform(-shift_m, shift_m, 3)
    return Placement(float(azimuth), float(elevation), (float(x), float(y), float(z)))


def intrinsics(width: int, height: int) -> Matrix:
    """K (px) of the camera; pixel centres lie at whole numbers."""
    focal = height / 2 / np.tan(np.radians(FOVY_DEG) / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


def table_homography(source: Matrix, new: Matrix, K: Matrix) -> Matrix:
    """3x3, from the source's pixels of the table to the new camera's; the arguments are world-from-camera poses."""

    def from_table(pose: Matrix) -> Matrix:
        return K @ np.linalg.inv(pose)[:3][:, [0, 1, 3]]

    return from_table(new) @ np.linalg.inv(from_table(source))


def product_pose(view: dict, amounts: dict[str, float]) -> Matrix:
    """World from the camera that stands where the product meant to put it: its change, in true metres.

    Where the product knows no true scale, its shift is taken as a share of its own look-at distance, which follows from
    the change, and applied at the true one.

    Args:
        view: of `meta/msdyn`, `camera_from_source`.
        amounts: of `meta/msdyn`, what was sampled; shifts in metres, or as shares of the look-at distance.
    """
    source_from_camera = np.linalg.inv(np.array(view["camera_from_source"], float))
    if any(name.startswith("shift_") and name.endswith("_m") for name in amounts):
        return Placement().world_from_camera() @ source_from_camera
    ahead = np.array([0.0, 0.0, 1.0])
    shares = np.array([amounts.get(f"shift_{axis}_rel", 0.0) for axis in "xyz"]) * amounts.get("shrunk_to", 1.0)
    per_distance = ahead - source_from_camera[:3, :3] @ ahead + shares
    distance = float(source_from_camera[:3, 3] @ per_distance / (per_distance @ per_distance))
    source_from_camera[:3, 3] *= DISTANCE_M / distance
    return Placement().world_from_camera() @ source_from_camera
