"""Simulated episodes with ground truth: true tracks to initialise a motion from, and others to test it with.

An episode is a folder with gt/meta.json, train.npz, bodies.npz and tracks.npz: depth and body id of every pixel, the
pose of every body (or the mesh of a cloth) at every frame, and a few points followed through the clip.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import (
    invert_se3,
    project,
    quaternion_to_matrix,
    se3,
    transform_points,
    unproject,
)
from lerobot_msdyn.core.observations import PointTracks

ROBOT, OBJECT = 1, 2  # instances
_LINKS = range(2, 8)  # body ids of the robot's moving links
_GATHERED = 10  # frames from which points are taken
_AGREES_M = 0.006  # a point is visible where the depth map is no farther from it
_CANDIDATES = 8  # triangles of the cloth among which a point's own is sought
_EDGE_M = 0.01  # about the length of a triangle's side


@dataclass(frozen=True)
class Cloth:
    """A mesh that moves."""

    body: int
    vertices: Float[Tensor, "t v 3"]  # m
    faces: Int[Tensor, "f 3"]


@dataclass(frozen=True)
class Simulated:
    """One episode and its ground truth."""

    depth: Float[Tensor, "t h w"]  # m
    segments: Int[Tensor, "t h w"]  # body id
    camera: CameraTrack
    moving: Int[Tensor, " m"]  # body ids
    poses: Float[Tensor, "t b 4 4"]  # world from body
    cloth: Cloth | None
    xyz: Float[Tensor, "n t 3"]  # m, points on moving bodies to test with
    visible: Bool[Tensor, "n t"]
    query: Int[Tensor, " n"]  # frame in which each is given
    body: Int[Tensor, " n"]


def read_simulated(folder: Path) -> Simulated:
    """The episode in a folder."""
    truth = folder / "gt"
    meta = json.loads((truth / "meta.json").read_text())
    train, bodies, tracks = (_arrays(truth / f"{name}.npz") for name in ("train", "bodies", "tracks"))
    depth = train["depth"].movedim(-1, 0).float() * meta["depth_unit_m"]
    frames, height, width = depth.shape
    camera = CameraTrack(train["K"].float().expand(frames, 3, 3).contiguous(), train["c2w"].float(), width, height)
    cloth = None
    if meta["flex_seg_id"] is not None:
        cloth = Cloth(meta["flex_seg_id"], bodies["flex_verts"].float(), bodies["flex_faces"].long())
    moving = torch.tensor(meta["dynamic_ids"])
    tested = torch.isin(tracks["body"].long(), moving)
    return Simulated(
        depth,
        train["seg"].movedim(-1, 0).long(),
        camera,
        moving,
        se3(quaternion_to_matrix(bodies["pose"][..., 3:]), bodies["pose"][..., :3]),
        cloth,
        tracks["xyz"].transpose(0, 1)[tested].contiguous(),
        tracks["visible"].T[tested].contiguous(),
        tracks["query_frame"][tested].long(),
        tracks["body"][tested].long(),
    )


def _arrays(path: Path) -> dict[str, Tensor]:
    """All arrays of numbers in an .npz file."""
    with np.load(path, allow_pickle=False) as content:
        return {name: torch.from_numpy(content[name]) for name in content.files if content[name].dtype.kind in "biuf"}


def instance_of(body: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """The robot is one instance, whatever else moves another one."""
    return torch.where(torch.isin(body, torch.tensor(_LINKS)), ROBOT, OBJECT)


def dense_tracks(episode: Simulated, count: int, seed: int = 0) -> PointTracks:
    """True tracks of about `count` points on moving bodies, taken from the depth maps of ten frames."""
    generator = torch.Generator().manual_seed(seed)
    frames = torch.linspace(0, len(episode.depth) - 1, _GATHERED).round().long().tolist()
    gathered = [_gather(episode, frame, count // _GATHERED, generator) for frame in frames]
    xyz, body = (torch.cat(each) for each in zip(*gathered, strict=True))
    in_camera = transform_points(episode.camera.camera_from_world, xyz.transpose(0, 1).contiguous())
    xy, z = project(in_camera, episode.camera.intrinsics)
    visible = _visible(episode, xy, z, body).T.contiguous()
    return PointTracks(xy.transpose(0, 1).contiguous(), visible, visible.float(), instance_of(body))


def observed(tracks: PointTracks, noise_px: float, dropped: float, seed: int = 0) -> PointTracks:
    """Tracks with noise along each axis and a share of their positions dropped."""
    generator = torch.Generator().manual_seed(seed)
    xy = tracks.xy + noise_px * torch.randn(tracks.xy.shape, generator=generator)
    visible = tracks.visible & (torch.rand(tracks.visible.shape, generator=generator) >= dropped)
    return PointTracks(xy, visible, visible.float(), tracks.instance)


def _gather(
    episode: Simulated, frame: int, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n t 3"], Int[Tensor, " n"]]:
    """Points (m) that are seen on moving bodies at a frame, where they are at every frame, and their bodies."""
    pixels = torch.isin(episode.segments[frame], episode.moving).nonzero()
    row, column = pixels[torch.randperm(len(pixels), generator=generator)[:count]].unbind(-1)
    xy = torch.stack((column, row), dim=-1) + 0.5
    in_camera = unproject(xy, episode.depth[frame, row, column], episode.camera.intrinsics[frame])
    points = transform_points(episode.camera.world_from_camera[frame], in_camera)
    body = episode.segments[frame, row, column]
    xyz = torch.zeros(len(points), len(episode.depth), 3)
    for label in body.unique().tolist():
        mine = body == label
        if episode.cloth is not None and label == episode.cloth.body:
            xyz[mine] = carried_by_mesh(points[mine], episode.cloth, frame)
        else:
            poses = episode.poses[:, label] @ invert_se3(episode.poses[frame, label])
            xyz[mine] = transform_points(poses, points[mine].expand(len(poses), -1, -1)).transpose(0, 1)
    return xyz, body


def carried_by_mesh(points: Float[Tensor, "n 3"], cloth: Cloth, frame: int) -> Float[Tensor, "n t 3"]:
    """Where points (m) near a mesh at a frame are at every frame: same place in their triangle, same height above it.

    A point's triangle is, of those with the nearest centres, the one that it lies least outside of and above.
    """
    corners = cloth.vertices[frame][cloth.faces]
    nearest = torch.cdist(points, corners.mean(1)).topk(min(_CANDIDATES, len(corners)), largest=False).indices
    a, b, c = corners[nearest].unbind(2)
    axes = torch.stack((b - a, c - a, _normals(corners[nearest])), dim=-1)
    u, v, height = torch.linalg.solve(axes, (points[:, None] - a)[..., None])[..., 0].unbind(-1)
    shares = torch.stack((1 - u - v, u, v), dim=-1)
    best = (_EDGE_M * (-shares.amin(-1)).clamp(min=0) + height.abs()).argmin(1)
    every = torch.arange(len(points))
    moving = cloth.vertices[:, cloth.faces[nearest[every, best]]]
    inside = (shares[every, best][..., None] * moving).sum(-2)
    return (inside + height[every, best][:, None] * _normals(moving)).transpose(0, 1)


def _normals(corners: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """Unit normals of triangles."""
    a, b, c = corners.unbind(-2)
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)


def _visible(
    episode: Simulated, xy: Float[Tensor, "t n 2"], z: Float[Tensor, "t n"], body: Int[Tensor, " n"]
) -> Bool[Tensor, "t n"]:
    """Where projected points are what the image shows: at the depth of the map, and on their own body."""
    frames, height, width = episode.depth.shape
    column, row = xy.floor().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = (torch.arange(frames)[:, None], row.clamp(0, height - 1), column.clamp(0, width - 1))
    return inside & ((episode.depth[at] - z).abs() < _AGREES_M) & (episode.segments[at] == body)
