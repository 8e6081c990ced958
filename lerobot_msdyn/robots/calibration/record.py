"""What a calibration file keeps of a robot: which description, and how its joints follow from the state."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.robots.description import Robot
from lerobot_msdyn.robots.mapping import JointMap


@dataclass(frozen=True)
class RobotRecord:
    """One robot in a calibration file; its root's frame is the cameras' world."""

    urdf: Path
    licence: str
    mapping: JointMap
    joints: tuple[str, ...]
    lag_s: float = 0.0  # by which the video is behind the state

    def entry(self) -> dict[str, Any]:
        """As JSON."""
        mapped = zip(self.joints, self.mapping.columns, self.mapping.scale, self.mapping.offset, strict=True)
        joints = {
            name: {"column": int(column), "scale": float(scale), "offset": float(offset)}
            for name, column, scale, offset in mapped
        }
        return {"urdf": str(self.urdf), "licence": self.licence, "joints": joints, "lag_s": self.lag_s}

    def values(self, state: Float[ndarray, "t s"], fps: int | float) -> Float64[ndarray, "t j"]:
        """Values of the movable joints (rad, m) at the moments that the frames show."""
        values = self.mapping.values(state)
        rate = np.gradient(values, 1 / fps, axis=0) if len(values) > 1 else np.zeros_like(values)
        return values + self.lag_s * rate

    def check(self, robot: Robot, columns: int, where: Path) -> None:
        """Whether it is of this robot, and of a state with so many numbers.

        Raises:
            PriorError: it is not.
        """
        last = int(self.mapping.columns.max())
        if self.joints != robot.movable or last >= columns:
            raise PriorError(
                f"{where}: its robot has joints {', '.join(self.joints)} in columns up to {last}; "
                f"{self.urdf} has {', '.join(robot.movable)} and the state {columns} numbers: calibrate again"
            )


def read_record(entry: Any, where: Path) -> RobotRecord:
    """The entry `robot` of a calibration file.

    Raises:
        PriorError: it is not what `RobotRecord.entry` writes.
    """
    try:
        joints = entry["joints"]
        columns = np.array([int(joint["column"]) for joint in joints.values()], np.int64)
        scale = np.array([float(joint["scale"]) for joint in joints.values()])
        offset = np.array([float(joint["offset"]) for joint in joints.values()])
        urdf, licence, lag_s = Path(entry["urdf"]), str(entry.get("licence", "")), float(entry.get("lag_s", 0))
        return RobotRecord(
            urdf, licence, JointMap(columns, scale, offset, "", np.zeros(len(columns), bool)), tuple(joints), lag_s
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise PriorError(f"{where}: its entry `robot` cannot be used ({error}); calibrate again") from error
