"""The robot: its description, where its links are by its joints, and the camera that films it (docs/robots.md)."""

from lerobot_msdyn.robots.description import Joint, Robot
from lerobot_msdyn.robots.find import find_description
from lerobot_msdyn.robots.kinematics import link_poses
from lerobot_msdyn.robots.load import load_robot
from lerobot_msdyn.robots.mapping import JointMap, map_joints

__all__ = ["Joint", "JointMap", "Robot", "find_description", "link_poses", "load_robot", "map_joints"]
