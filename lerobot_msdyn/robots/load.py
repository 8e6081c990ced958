"""A robot from a URDF file: its surfaces are thinned out, sampled and kept."""

import hashlib
import json
import logging
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from lerobot_msdyn.core.errors import ConfigError, first_line
from lerobot_msdyn.robots.description import Joint, Robot

logger = logging.getLogger(__name__)

INSTALL = "pip install 'lerobot_msdyn[robots]'"
POINTS = 4000  # of a robot's surface
CELLS = 60  # of the grid in which vertices are merged, along the longest side of the largest part
_FORMAT = 1  # of the kept file
_ARRAYS = ("vertices", "faces", "face_link", "points", "normals", "point_link")


def load_robot(urdf: Path, licence: str = "", cache: Path | None = None) -> Robot:
    """The robot that a URDF file describes.

    Args:
        urdf: the file; meshes lie where it says, relative to it, or by `package://` in a folder above it.
        licence: of the description, for the record.
        cache: folder in which the reduced meshes are kept; None: nowhere.

    Raises:
        ConfigError: it cannot be read, has no meshes, or some of them are absent.
    """
    text = read_urdf(urdf)
    kept = None if cache is None else cache / f"{urdf.stem}-{_digest(urdf, text)}.safetensors"
    robot = None if kept is None else _read(kept)
    if robot is None:
        robot = _parsed(urdf)
        if kept is not None:
            _keep(kept, robot)
    return replace(robot, licence=licence, source=str(urdf))


def read_urdf(urdf: Path) -> bytes:
    """The content of a robot's description.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        return urdf.read_bytes()
    except OSError as error:
        raise ConfigError(f"{urdf}: the robot's description cannot be read ({first_line(error)})") from error


def mesh_file(urdf: Path, name: str) -> Path:
    """Where a mesh lies that a URDF names."""
    if name.startswith("package://"):
        package, _, inside = name.removeprefix("package://").partition("/")
        for folder in urdf.parents:
            for path in (folder / package / inside, folder / inside):
                if path.exists():
                    return path
        return urdf.parent / package / inside
    return urdf.parent / name.removeprefix("file://")


def _digest(urdf: Path, text: bytes) -> str:
    total = hashlib.blake2b(text + str((_FORMAT, POINTS, CELLS)).encode(), digest_size=12)
    for name in sorted(set(re.findall(rb'mesh[^>]*filename="([^"]+)"', text))):
        path = mesh_file(urdf, name.decode())
        if path.exists():
            total.update(path.read_bytes())
    return total.hexdigest()


def _parsed(urdf: Path) -> Robot:
    try:
        import yourdfpy
    except ImportError as error:
        raise ConfigError(f"a robot's description needs yourdfpy and trimesh: {INSTALL}") from error
    try:
        model = yourdfpy.URDF.load(str(urdf), build_scene_graph=False, load_meshes=False).robot
        names = [link.name for link in model.links]
        joints = _ordered([_joint(joint, names) for joint in model.joints], len(names))
    except Exception as error:  # XML, missing attributes, unknown links: each with errors of its own
        raise ConfigError(f"{urdf}: not a robot's description in URDF ({first_line(error)})") from error
    parts = [
        (index, visual)
        for index, link in enumerate(model.links)
        for visual in (link.visuals or link.collisions)
        if visual.geometry is not None
    ]
    missing = [
        str(path)
        for path in (mesh_file(urdf, v.geometry.mesh.filename) for _, v in parts if v.geometry.mesh is not None)
        if not path.exists()
    ]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ConfigError(
            f"{urdf}: mesh {missing[0]}{more} is absent; expected the meshes where the URDF names them: copy the "
            "description with its meshes"
        )
    if not parts:
        raise ConfigError(f"{urdf}: no link has a shape (<visual> or <collision>); a description with meshes is needed")
    meshes = [(link, *_mesh(urdf, visual)) for link, visual in parts]
    extent = max(float(np.ptp(vertices, axis=0).max()) for _, vertices, _ in meshes)
    reduced = [(link, *_merged(vertices, faces, extent / CELLS)) for link, vertices, faces in meshes]
    return _assembled(urdf.stem if not model.name else str(model.name), names, joints, reduced)


def _joint(joint: Any, links: list[str]) -> Joint:
    limit, mimic = joint.limit, joint.mimic
    axis = np.asarray(joint.axis if joint.axis is not None else (1.0, 0, 0), np.float64)
    return Joint(
        joint.name,
        joint.type,
        links.index(joint.parent),
        links.index(joint.child),
        np.eye(4) if joint.origin is None else np.asarray(joint.origin, np.float64),
        axis / max(float(np.linalg.norm(axis)), 1e-12),
        -np.pi if limit is None or limit.lower is None else float(limit.lower),
        np.pi if limit is None or limit.upper is None else float(limit.upper),
        "" if mimic is None else mimic.joint,
        1.0 if mimic is None or mimic.multiplier is None else float(mimic.multiplier),
        0.0 if mimic is None or mimic.offset is None else float(mimic.offset),
    )


def _ordered(joints: list[Joint], links: int) -> tuple[Joint, ...]:
    """From the root to the tips."""
    known = set(range(links)) - {joint.child for joint in joints}
    if len(known) != 1:
        raise ValueError(f"{len(known)} root links; expected one")
    ordered: list[Joint] = []
    while len(ordered) < len(joints):
        ready = [joint for joint in joints if joint.parent in known and joint.child not in known]
        if not ready:
            raise ValueError("its joints form a loop")
        ordered += ready
        known |= {joint.child for joint in ready}
    return tuple(ordered)


def _mesh(urdf: Path, visual: Any) -> tuple[ndarray, ndarray]:
    """Vertices in the link's frame, and faces."""
    import trimesh

    shape = visual.geometry
    if shape.mesh is not None:
        path = mesh_file(urdf, shape.mesh.filename)
        try:
            mesh = trimesh.load_mesh(path)
        except Exception as error:  # readers of several formats
            raise ConfigError(f"{urdf}: mesh {path} cannot be read ({first_line(error)})") from error
        scale = np.ones(3) if shape.mesh.scale is None else np.broadcast_to(np.asarray(shape.mesh.scale, float), 3)
        vertices = np.asarray(mesh.vertices, np.float64) * scale
    else:
        if shape.box is not None:
            mesh = trimesh.creation.box(extents=shape.box.size)
        elif shape.cylinder is not None:
            mesh = trimesh.creation.cylinder(radius=shape.cylinder.radius, height=shape.cylinder.length)
        else:
            mesh = trimesh.creation.icosphere(radius=shape.sphere.radius)
        vertices = np.asarray(mesh.vertices, np.float64)
    pose = np.eye(4) if visual.origin is None else np.asarray(visual.origin, np.float64)
    return vertices @ pose[:3, :3].T + pose[:3, 3], np.asarray(mesh.faces, np.int64)


def _merged(vertices: ndarray, faces: ndarray, cell: float) -> tuple[ndarray, ndarray]:
    """A mesh whose vertices are merged in the cells of a grid; faces that vanish are left out."""
    _, inverse = np.unique(np.floor(vertices / cell).astype(np.int64), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    count = np.bincount(inverse)
    mean = np.stack([np.bincount(inverse, vertices[:, k]) / count for k in range(3)], axis=1)
    merged = inverse[faces]
    distinct = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    merged = merged[distinct]
    _, first = np.unique(np.sort(merged, axis=1), axis=0, return_index=True)
    return mean, merged[np.sort(first)]


def _assembled(
    name: str, links: list[str], joints: tuple[Joint, ...], meshes: list[tuple[int, ndarray, ndarray]]
) -> Robot:
    starts = np.cumsum([0, *(len(vertices) for _, vertices, _ in meshes)])
    vertices = np.concatenate([vertices for _, vertices, _ in meshes]).astype(np.float32)
    faces = np.concatenate([f + start for (_, _, f), start in zip(meshes, starts, strict=False)]).astype(np.int32)
    face_link = np.concatenate([np.full(len(f), link, np.int32) for link, _, f in meshes])
    points, normals, chosen = _samples(vertices, faces)
    return Robot(
        name, tuple(links), joints, vertices, faces, face_link, points, normals, face_link[chosen].astype(np.int32)
    )


def _samples(
    vertices: Float32[ndarray, "v 3"], faces: Int32[ndarray, "f 3"]
) -> tuple[Float32[ndarray, "n 3"], Float32[ndarray, "n 3"], Int32[ndarray, " n"]]:
    """Points evenly over the surface, their normals, and the faces that they lie on."""
    corners = vertices[faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    rng = np.random.default_rng(0)
    place = (np.arange(POINTS) + rng.random(POINTS)) / POINTS
    chosen = np.searchsorted(np.cumsum(area) / area.sum(), place).clip(0, len(faces) - 1)
    u, v = rng.random((2, POINTS, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = (corners[chosen, k] for k in range(3))
    points = a + u * (b - a) + v * (c - a)
    normals = cross[chosen] / np.maximum(area[chosen], 1e-18)[:, None]
    return points.astype(np.float32), normals.astype(np.float32), chosen.astype(np.int32)


def _keep(path: Path, robot: Robot) -> None:
    joints = [
        {**asdict(joint), "parent_from_joint": joint.parent_from_joint.tolist(), "axis": joint.axis.tolist()}
        for joint in robot.joints
    ]
    metadata = {"name": robot.name, "links": json.dumps(robot.links), "joints": json.dumps(joints)}
    part = path.with_suffix(".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file({name: np.ascontiguousarray(getattr(robot, name)) for name in _ARRAYS}, part, metadata)
        part.replace(path)
    except OSError as error:
        logger.warning("%s cannot be written (%s): the robot's reduced meshes are not kept", path, error)


def _read(path: Path) -> Robot | None:
    from safetensors import safe_open

    if not path.exists():
        return None
    try:
        with safe_open(path, "np") as file:
            metadata = file.metadata()
        arrays = load_file(path)
        joints = tuple(
            Joint(
                **{
                    **joint,
                    "parent_from_joint": np.array(joint["parent_from_joint"]),
                    "axis": np.array(joint["axis"]),
                }
            )
            for joint in json.loads(metadata["joints"])
        )
        return Robot(metadata["name"], tuple(json.loads(metadata["links"])), joints, **arrays)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        logger.warning("%s is damaged (%s): made again", path, type(error).__name__)
        return None
