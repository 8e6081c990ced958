"""Arms that no one has built: URDF files of boxes, cylinders and a small mesh, written by the tests."""

import struct
from pathlib import Path

import numpy as np

JOINTS = ("pan", "lift", "elbow", "wrist", "roll")


def write_arm(folder: Path, seed: int = 0) -> Path:
    """An arm with five joints, a gripper and a mesh in STL; `seed` changes the lengths and widths of its links."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    reach = [0.07, *rng.uniform(0.09, 0.17, 3), 0.06]
    wide = rng.uniform(0.025, 0.05, 5)
    _write_stl(folder / "base.stl", 0.1, 0.08, 0.06)
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1")
    links = ['<link name="base"><visual><geometry><mesh filename="package://arm/base.stl"/></geometry></visual></link>']
    joints, at = [], 0.06
    for index, (name, axis, length, width) in enumerate(zip(JOINTS, axes, reach, wide, strict=True)):
        depth = width * rng.uniform(0.6, 1.4)
        links.append(
            f'<link name="{name}_link"><visual><origin xyz="{0.3 * depth} 0 {length / 2}"/><geometry>'
            f'<box size="{width} {depth} {length}"/></geometry></visual></link>'
        )
        parent = "base" if index == 0 else f"{JOINTS[index - 1]}_link"
        joints.append(_joint(name, "revolute", parent, f"{name}_link", f"0 0 {at}", axis, -1.9, 1.9))
        at = length
    links.append(
        '<link name="jaw"><visual><origin xyz="0.02 0 0.04"/><geometry><cylinder radius="0.008" length="0.08"/>'
        "</geometry></visual></link>"
    )
    joints.append(_joint("gripper", "revolute", "roll_link", "jaw", f"0.01 0 {at}", "0 1 0", -0.2, 1.4))
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(links)}{"".join(joints)}</robot>')
    return path


def swing(frames: int, seed: int = 0) -> np.ndarray:
    """Degrees of the five joints and 0..100 of the gripper, [frames, 6]: smooth, and through much of the range."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)[:, None]
    phase, speed = rng.uniform(0, 6.28, (2, 1, 6))
    wave = np.sin(2 * np.pi * (0.7 + 0.15 * speed) * time + phase)
    return np.array([0, 25, 55, 20, 0, 50]) + wave * np.array([70, 30, 40, 45, 60, 45])


def _joint(name: str, kind: str, parent: str, child: str, xyz: str, axis: str, low: float, high: float) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>'
    )


def _write_stl(path: Path, x: float, y: float, z: float) -> None:
    """A box that stands on the ground."""
    corners = np.array([[a * x / 2, b * y / 2, c * z] for a in (-1, 1) for b in (-1, 1) for c in (0, 1)], np.float32)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    with path.open("wb") as file:
        file.write(bytes(80) + struct.pack("<I", len(faces)))
        for face in faces:
            file.write(struct.pack("<3f", 0, 0, 0) + corners[list(face)].tobytes() + bytes(2))
