"""The robot: its description, where its links are by its joints, and the camera that films it (docs/robots.md).

`link_poses` is imported when it is first used: all else needs no torch.
"""

from typing import TYPE_CHECKING, Any

from lerobot_msdyn.robots.description import Joint, Robot
from lerobot_msdyn.robots.find import check_description, find_description
from lerobot_msdyn.robots.load import load_robot
from lerobot_msdyn.robots.mapping import JointMap, map_joints

if TYPE_CHECKING:
    from lerobot_msdyn.robots.kinematics import link_poses

__all__ = [
    "Joint",
    "JointMap",
    "Robot",
    "check_description",
    "find_description",
    "link_poses",
    "load_robot",
    "map_joints",
]


def __getattr__(name: str) -> Any:
    if name != "link_poses":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lerobot_msdyn.robots.kinematics import link_poses

    return link_poses
