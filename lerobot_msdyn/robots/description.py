"""A robot: a tree of links and joints, and the links' surfaces."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy import ndarray

MOVABLE = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Joint:
    """A joint between two links, as URDF has it."""

    name: str
    kind: str  # revolute, continuous, prismatic or fixed
    parent: int  # links
    child: int
    parent_from_joint: Float64[ndarray, "4 4"]
    axis: Float64[ndarray, "3"]  # unit vector in the joint's frame
    lower: float = -np.pi  # rad, or m
    upper: float = np.pi
    mimics: str = ""  # joint that it follows by value = factor * value + offset
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Robot:
    """Links, joints in the order from the root to the tips, and the surfaces in their links' frames."""

    name: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    vertices: Float32[ndarray, "v 3"]  # m
    faces: Int32[ndarray, "f 3"]  # vertices
    face_link: Int32[ndarray, " f"]
    points: Float32[ndarray, "n 3"]  # m, evenly over the surface
    normals: Float32[ndarray, "n 3"]
    point_link: Int32[ndarray, " n"]
    licence: str = ""
    source: str = ""

    @property
    def movable(self) -> tuple[str, ...]:
        """Names of the joints that have a value of their own."""
        return tuple(joint.name for joint in self.joints if joint.kind in MOVABLE and not joint.mimics)

    def joint(self, name: str) -> Joint:
        """The joint of a name."""
        return next(joint for joint in self.joints if joint.name == name)

    @cached_property
    def moved_by(self) -> Bool[ndarray, "l j"]:
        """Whether each of the movable joints moves each of the links."""
        index = {name: k for k, name in enumerate(self.movable)}
        moved = np.zeros((len(self.links), len(index)), bool)
        for joint in self.joints:
            moved[joint.child] |= moved[joint.parent]
            name = joint.mimics or joint.name
            if name in index:
                moved[joint.child, index[name]] = True
        return moved
