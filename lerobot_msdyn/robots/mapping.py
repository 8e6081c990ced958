"""From a dataset's state to joint angles: which number is which joint, and in what unit."""

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from numpy import ndarray

from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.robots.description import Joint, Robot

logger = logging.getLogger(__name__)

UNITS = ("auto", "degrees", "radians", "normalised", "ticks")
TICKS = 4096  # of a servo's turn
_GRIPPER = re.compile(r"grip|jaw|finger|claw")
_POSE = re.compile(
    r"(^|[._])(x|y|z|rx|ry|rz|roll|pitch|yaw|qx|qy|qz|qw|ee|eef|tcp)($|[._])|end_effector|cartesian|pose"
)
_LEAST_MOTION = math.radians(2)


@dataclass(frozen=True)
class JointMap:
    """values = scale * state[columns] + offset, for the movable joints of a robot."""

    columns: Int64[ndarray, " j"]  # of the state; -1: not recorded, the joint rests
    scale: Float64[ndarray, " j"]  # rad (or m) per unit of the state
    offset: Float64[ndarray, " j"]
    units: str
    grips: Bool[ndarray, " j"]  # grippers, which are in shares of their range

    def values(self, state: Float[ndarray, "t s"]) -> Float64[ndarray, "t j"]:
        """Values of the movable joints: rad, or m."""
        picked = np.where(self.columns >= 0, state[:, np.maximum(self.columns, 0)].astype(np.float64), 0.0)
        return picked * self.scale + self.offset


def map_joints(
    robot: Robot,
    names: Sequence[str] | None,
    state: Float[ndarray, "t s"],
    units: str = "auto",
    renamed: Mapping[str, str] | None = None,
) -> JointMap:
    """The joints that a state holds, by their names.

    Names are compared by their letters and digits, without `.pos`, `joint` and the k of constants (kLeftElbow). Where
    none of them agrees but there are as many numbers as joints, they are taken in the robot's order.

    Args:
        robot: the robot.
        names: of the state's numbers; None: they have none.
        state: all that is recorded, by which the unit is told.
        units: auto, degrees, radians, normalised (-100..100 of each joint's range) or ticks (4096 a turn).
        renamed: name in the state -> name of the robot's joint.

    Raises:
        ConfigError: the state is not that of these joints, or nothing moves.
    """
    if units not in UNITS:
        raise ConfigError(f"robot.units is {units!r}; expected one of {', '.join(UNITS)}")
    columns = _columns(robot, names, state.shape[1], renamed or {})
    known = columns >= 0
    angular = np.array([robot.joint(name).kind != "prismatic" for name in robot.movable])
    labels = [_label(names, int(column), name) for column, name in zip(columns, robot.movable, strict=True)]
    grips = np.array([bool(_GRIPPER.search(label.lower())) for label in labels])
    values = state[:, columns[known & angular & ~grips]]
    told = _units(values) if units == "auto" else units
    scale, offset = np.zeros(len(columns)), np.zeros(len(columns))
    for index, (name, column) in enumerate(zip(robot.movable, columns, strict=True)):
        joint = robot.joint(name)
        if column < 0:
            offset[index] = min(max(0.0, joint.lower), joint.upper)
            continue
        scale[index], offset[index] = _linear(joint, told, bool(grips[index]), state[:, column])
    mapped = JointMap(columns, scale, offset, told, grips)
    _check_motion(robot, mapped, state)
    return mapped


def in_units(robot: Robot, mapping: JointMap, units: str) -> JointMap:
    """The same with the joints that turn, but the grippers, in degrees or normalised."""
    scale, offset = mapping.scale.copy(), mapping.offset.copy()
    for index, name in enumerate(robot.movable):
        joint = robot.joint(name)
        if mapping.columns[index] >= 0 and joint.kind != "prismatic" and not mapping.grips[index]:
            scale[index], offset[index] = _linear(joint, units, False, np.zeros(1))
    return replace(mapping, scale=scale, offset=offset, units=units)


def _columns(robot: Robot, names: Sequence[str] | None, count: int, renamed: Mapping[str, str]) -> Int64[ndarray, " j"]:
    joints = {_plain(name): index for index, name in enumerate(robot.movable)}
    unknown = [f"{old}: {new}" for old, new in renamed.items() if _plain(new) not in joints]
    if unknown:
        raise ConfigError(f"robot.joints has {'; '.join(unknown)}; expected joints of {robot.name}: {_listed(robot)}")
    listed = list(names) if names is not None and len(names) == count else [str(index) for index in range(count)]
    columns = np.full(len(joints), -1, np.int64)
    for column, name in enumerate(listed):
        index = joints.get(_plain(renamed.get(name, name)))
        if index is not None:
            columns[index] = column
    if (columns >= 0).any():
        return columns
    where = f"observation.state has {', '.join(map(repr, listed))}"
    posed = [name for name in listed if _POSE.search(name.lower())]
    if 2 * len(posed) >= len(listed):
        raise ConfigError(f"{where}: poses of the end effector; expected joint angles (inverse kinematics is not done)")
    if count != len(joints):
        raise ConfigError(
            f"{where}; {robot.name} has joints {_listed(robot)}: none agrees, and there are {count} numbers for "
            f"{len(joints)} joints; name them by --robot.joints '{{NAME_IN_STATE: JOINT}}', or give the right robot"
        )
    logger.warning("%s; none is a joint of %s: taken in its order, %s", where, robot.name, _listed(robot))
    return np.arange(count)


def _label(names: Sequence[str] | None, column: int, joint: str) -> str:
    return joint if names is None or column < 0 or column >= len(names) else f"{names[column]} {joint}"


def _plain(name: str) -> str:
    name = re.sub(r"^k(?=[A-Z])", "", name).lower().removesuffix(".pos")
    return re.sub(r"[^a-z0-9]", "", name).removesuffix("joint")


def _listed(robot: Robot) -> str:
    return ", ".join(robot.movable)


def _units(values: Float[ndarray, "t j"]) -> str:
    largest = float(np.abs(values).max()) if values.size else 0.0
    if largest > 400:
        return "ticks"
    return "radians" if largest <= 2 * math.pi + 0.1 else "degrees"


def _linear(joint: Joint, units: str, grips: bool, column: Float[ndarray, " t"]) -> tuple[float, float]:
    """Scale and offset of a joint."""
    span = joint.upper - joint.lower
    if grips and units != "ticks" and (units != "radians" or float(column.max()) > joint.upper + 1):
        return span / 100, joint.lower  # LeRobot's grippers: 0..100 of their range
    if joint.kind == "prismatic" or units == "radians":
        return 1.0, 0.0
    if units == "normalised":
        return span / 200, (joint.lower + joint.upper) / 2
    if units == "ticks":
        return 2 * math.pi / TICKS, -math.pi
    return math.pi / 180, 0.0


def _check_motion(robot: Robot, mapped: JointMap, state: Float[ndarray, "t s"]) -> None:
    values = mapped.values(state)
    if not np.isfinite(values).all():
        raise ConfigError("observation.state has NaN or infinite values; expected joint angles")
    if float(np.ptp(values, axis=0).max(initial=0)) < _LEAST_MOTION:
        raise ConfigError(
            f"observation.state: no joint of {robot.name} moves by 2 degrees in {len(state)} frames; nothing can be "
            "told from it"
        )
