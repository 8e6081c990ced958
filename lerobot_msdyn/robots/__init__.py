"""The robot: its description, where its links are by its joints, and the camera that films it (docs/robots.md).

What is imported here needs no torch; `robots.kinematics`, where links are by the joints, does.
"""

from lerobot_msdyn.robots.description import Joint, Robot
from lerobot_msdyn.robots.find import check_description, find_description
from lerobot_msdyn.robots.load import load_robot
from lerobot_msdyn.robots.mapping import JointMap, map_joints

__all__ = ["Joint", "JointMap", "Robot", "check_description", "find_description", "load_robot", "map_joints"]
