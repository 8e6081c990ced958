"""A synthetic scene: what a camera sees of it, and where its surface points go."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.core.geometry import project, transform_points
from lerobot_msdyn.render.cpu.threads import in_threads
from lerobot_msdyn.synthetic import desk
from lerobot_msdyn.synthetic.choreography import Choreography, choreograph
from lerobot_msdyn.synthetic.desk import Primitive
from lerobot_msdyn.synthetic.intersect import SHEET, Geometry
from lerobot_msdyn.synthetic.raycast import Appearance, Pinhole, see_points, trace_color, trace_surface
from lerobot_msdyn.synthetic.textures import Texture, mip_levels
from lerobot_msdyn.synthetic.viewpoints import recorded_cameras

OBJECTS = {  # instance -> its bodies, in the order of the instance ids
    "robot": ("turret", "upper_arm", "forearm", "gripper", "finger_left", "finger_right"),
    "block": ("block",),
    "lid": ("lid",),
    "sheet": ("sheet", "dowel"),
    "hand": ("palm", "thumb", "index", "middle", "ring"),
    "windmill": ("rotor",),
}
MIP_LEVELS = 6
LAMP, LAMP_RADIUS = (-0.75, -0.55, 1.25), 0.09  # m
LAMP_RAYS = 8


@dataclass(frozen=True)
class SyntheticView:
    """What a camera sees, frame by frame."""

    rgb: UInt8[Tensor, "t h w 3"]
    depth: Float[Tensor, "t h w"]  # m, z-depth at the pixel centre
    instances: UInt8[Tensor, "t h w"]  # at the pixel centre; 0 = whatever stands still in this episode


@dataclass(frozen=True)
class SyntheticTracks:
    """Points that stay on the surface of what moves."""

    positions: Float[Tensor, "n t 3"]  # m, world
    xy: Float[Tensor, "n t 2"]  # px in the recorded camera
    visible: Bool[Tensor, "n t"]  # in front of everything else and inside the image
    instance: Int[Tensor, " n"]  # instance id, never 0
    body: Int[Tensor, " n"]  # index into SyntheticScene.body_names
    query: Int[Tensor, " n"]  # frame in which the point was picked, and is visible

    def __len__(self) -> int:
        return self.xy.shape[0]


@dataclass(frozen=True)
class Surface:
    """The exact surface behind every pixel of a view."""

    depth: np.ndarray  # [t, h, w] float32, m
    primitive: np.ndarray  # [t, h, w] int16
    local: np.ndarray  # [t, h, w, 3] float32, m, in the primitive's frame


@dataclass(frozen=True)
class SyntheticScene:
    """One episode on a desk; made by `make_scene`."""

    kind: str
    seed: int
    episode: int
    fps: int
    task: str
    cameras: dict[str, CameraTrack]  # "front" and "side" stand still, "wrist" rides on the gripper
    state: Float[Tensor, "t 6"]  # choreography.STATE_NAMES, m and rad
    body_names: tuple[str, ...]
    world_from_body: Float[Tensor, "b t 4 4"]  # of the sheet (not rigid): the identity
    instance_names: tuple[str, ...]  # by instance id, "background" first
    instance_of_body: Int[Tensor, " b"]
    primitives: tuple[Primitive, ...] = field(repr=False)
    geometry: tuple[Geometry, ...] = field(repr=False)  # per frame
    look: Appearance = field(repr=False)

    def __len__(self) -> int:
        return len(self.geometry)

    @property
    def camera(self) -> CameraTrack:
        """The recorded camera."""
        return self.cameras["front"]

    @property
    def action(self) -> Float[Tensor, "t 6"]:
        """The commanded state: that of the next frame."""
        return torch.cat((self.state[1:], self.state[-1:]))

    def render(self, camera: CameraTrack, frames: Sequence[int] | None = None) -> SyntheticView:
        """Colour, depth and instances from any camera.

        `frames` are the scene's frames that the camera's poses belong to, by default all of them.

        Raises:
            ConfigError: the camera has another number of poses.
        """
        surface = self.surface(camera, frames)
        rgb = np.zeros((*surface.depth.shape, 3), np.uint8)

        def trace(geometry: Geometry, pinhole: Pinhole, i: int) -> None:
            trace_color(geometry, self.look, pinhole, rgb[i])

        self._each_frame(camera, frames, trace)
        # index -1 (no surface) reads the last entry
        instances = np.append(self.instance_of_primitive, 0)[surface.primitive].astype(np.uint8)
        return SyntheticView(torch.from_numpy(rgb), torch.from_numpy(surface.depth), torch.from_numpy(instances))

    def surface(self, camera: CameraTrack, frames: Sequence[int] | None = None) -> Surface:
        """Which primitive, and where on it, every pixel centre shows; arguments as for `render`."""
        shape = (len(camera), camera.height, camera.width)
        out = Surface(np.zeros(shape, np.float32), np.zeros(shape, np.int16), np.zeros((*shape, 3), np.float32))

        def trace(geometry: Geometry, pinhole: Pinhole, i: int) -> None:
            trace_surface(geometry, pinhole, out.depth[i], out.primitive[i], out.local[i])

        self._each_frame(camera, frames, trace)
        return out

    def tracks(self, count: int, seed: int = 0) -> SyntheticTracks:
        """About `count` points on moving instances, shared equally among them and spread over the episode.

        Each is picked at a visible pixel of the recorded camera. None if nothing moves.
        """
        primitive, local, query = self._pick(count, np.random.default_rng(seed))
        positions = np.zeros((len(self), len(query), 3))
        visible = np.zeros((len(self), len(query)), np.bool_)

        def follow(geometry: Geometry, pinhole: Pinhole, i: int) -> None:
            see_points(geometry, pinhole, primitive, local, positions[i], visible[i])

        self._each_frame(self.camera, None, follow)
        points = torch.from_numpy(positions).float()
        xy, depth = project(transform_points(self.camera.camera_from_world, points), self.camera.intrinsics)
        size = torch.tensor([self.camera.width, self.camera.height])
        inside = (depth > 0) & (xy >= 0).all(-1) & (xy < size).all(-1)
        return SyntheticTracks(
            positions=points.transpose(0, 1).contiguous(),
            xy=xy.transpose(0, 1).contiguous(),
            visible=(torch.from_numpy(visible) & inside).T.contiguous(),
            instance=torch.from_numpy(self.instance_of_primitive[primitive]),
            body=torch.from_numpy(self.body_of_primitive[primitive]),
            query=torch.from_numpy(query),
        )

    @property
    def body_of_primitive(self) -> np.ndarray:
        """Index into `body_names` [P]."""
        return np.array([self.body_names.index(p.body) for p in self.primitives])

    @property
    def instance_of_primitive(self) -> np.ndarray:
        """Instance id [P]."""
        return self.instance_of_body.numpy()[self.body_of_primitive]

    def _pick(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Primitive [n], local point [n, 3] and frame [n] of pixels that show moving instances."""
        surface = self.surface(self.camera)
        shown = self.instance_of_primitive[surface.primitive]
        ids = [i for i in range(1, len(self.instance_names)) if (shown == i).any()]
        picked = []
        for k, i in enumerate(ids):
            pixels = np.flatnonzero(shown == i)
            wanted = count // len(ids) + (k < count % len(ids))
            picked.append(rng.choice(pixels, min(wanted, len(pixels)), replace=False))
        index = np.concatenate(picked) if picked else np.zeros(0, np.int64)
        local = surface.local.reshape(-1, 3)[index].astype(np.float64)
        return surface.primitive.reshape(-1)[index].astype(np.int64), local, index // shown[0].size

    def _each_frame(
        self, camera: CameraTrack, frames: Sequence[int] | None, work: Callable[[Geometry, Pinhole, int], None]
    ) -> None:
        """Calls `work(geometry, pinhole, i)` for every pose i of a camera, on all cores."""
        times = range(len(self)) if frames is None else frames
        if len(times) != len(camera):
            raise ConfigError(
                f"camera has {len(camera)} poses for {len(times)} frames of the synthetic scene; give one per frame"
            )
        each = in_threads(lambda i: work(self.geometry[times[i]], pinhole(camera, i), i), range(len(times)))
        deque(each, maxlen=0)


def pinhole(camera: CameraTrack, i: int) -> Pinhole:
    """One pose of a camera as the ray-caster takes it."""
    pose = camera.world_from_camera[i].double().numpy()
    return Pinhole(
        camera.intrinsics[i].double().numpy(),
        np.ascontiguousarray(pose[None, :3, :3]),
        np.ascontiguousarray(pose[:3, 3]),
    )


def make_scene(
    kind: str, seed: int, frames: int, width: int, height: int, fps: int = 30, episode: int = 0
) -> SyntheticScene:
    """A desk with a robot arm; what moves depends on the kind.

    Kinds: "push" (the gripper pushes a block), "lid" (it opens a hinged lid), "sheet" (it bends a sheet), "hand" (a
    person's hand takes the block and puts it elsewhere), "spin" (a windmill turns), "static" (nothing moves), "all"
    (the gripper pushes while lid and sheet move by themselves). The seed decides textures and clutter. `episode` varies
    starting places and motion at the same desk, so that the episodes of a dataset share background and camera.

    Raises:
        ConfigError: unknown kind, or no frame.
    """
    moves = choreograph(kind, frames, np.random.default_rng([seed, 1, episode]))
    poses = moves.poses | {"sheet": moves.poses["world"]}
    furniture = tuple(p for p in desk.primitives(np.random.default_rng([seed, 0])) if p.body in poses)
    names = tuple(poses)
    instance_names, instance_of_body = _instances(names, moves)
    tasks = {
        "push": "push the block",
        "lid": "open the tool box",
        "sheet": "lift the mat",
        "hand": "wait for the block",
        "spin": "wait",
        "static": "wait",
    }
    return SyntheticScene(
        kind=kind,
        seed=seed,
        episode=episode,
        fps=fps,
        task=tasks.get(kind, "push the block while the box opens and the mat curls"),
        cameras=recorded_cameras(moves.poses["gripper"], width, height),
        state=torch.from_numpy(moves.states).float(),
        body_names=names,
        world_from_body=torch.from_numpy(np.stack([poses[name] for name in names])).float(),
        instance_names=instance_names,
        instance_of_body=torch.from_numpy(instance_of_body),
        primitives=furniture,
        geometry=tuple(_geometry(furniture, moves, t) for t in range(frames)),
        look=_appearance(furniture, desk.painted(np.random.default_rng([seed, 2]))),
    )


def _instances(bodies: tuple[str, ...], moves: Choreography) -> tuple[tuple[str, ...], np.ndarray]:
    """Names by instance id and id per body; objects that stand still in the whole episode belong to 0."""
    names, ids = ["background"], np.zeros(len(bodies), np.int64)
    for name, parts in OBJECTS.items():
        if not set(parts) <= set(bodies):
            continue
        motions = [moves.sheet_nodes if part == "sheet" else moves.poses[part] for part in parts]
        if any((motion != motion[:1]).any() for motion in motions):
            ids[[bodies.index(part) for part in parts]] = len(names)
            names.append(name)
    return tuple(names), ids


def _geometry(furniture: tuple[Primitive, ...], moves: Choreography, t: int) -> Geometry:
    """All primitives at frame t."""
    nodes, across = moves.sheet_nodes[t], moves.sheet_across
    sheet = np.concatenate((nodes, nodes + across))
    sheet_pose = np.eye(4)
    sheet_pose[:3, 3] = (sheet.min(0) + sheet.max(0)) / 2
    poses = np.stack(
        [sheet_pose if p.shape == SHEET else moves.poses[p.body][t] @ p.body_from_primitive for p in furniture]
    )
    half = np.array([p.half for p in furniture])
    radius = np.linalg.norm(half, axis=1)
    for i, primitive in enumerate(furniture):
        if primitive.shape == SHEET:
            radius[i] = np.linalg.norm(sheet - sheet_pose[:3, 3], axis=1).max()
    return Geometry(
        shape=np.array([p.shape for p in furniture]),
        half=half,
        radius=radius * (1 + 1e-9),
        position=np.ascontiguousarray(poses[:, :3, 3]),
        rotation=np.ascontiguousarray(poses[:, :3, :3]),
        casts_shadow=np.array([p.casts_shadow for p in furniture]),
        sheet_nodes=np.ascontiguousarray(nodes),
        sheet_across=across,
    )


def _appearance(furniture: tuple[Primitive, ...], textures: dict[str, Texture]) -> Appearance:
    """Materials of the primitives and all textures packed into one table."""
    names = list(textures)
    texels: list[np.ndarray] = []
    levels = np.zeros((len(names), MIP_LEVELS, 3), np.int64)
    first = 0
    for q, name in enumerate(names):
        for k, level in enumerate(mip_levels(textures[name], MIP_LEVELS)):
            levels[q, k] = (first, *level.shape[:2])
            texels.append(level.reshape(-1, 3))
            first += len(texels[-1])
    return Appearance(
        side=np.array([names.index(p.side) for p in furniture]),
        top=np.array([names.index(p.top) for p in furniture]),
        gloss=np.array([p.gloss for p in furniture]),
        texels=np.concatenate(texels),
        levels=levels,
        extent=np.array([textures[name].extent for name in names]),
        lamp=np.array(LAMP),
        lamp_radius=LAMP_RADIUS,
        lamp_points=_lamp_points(),
    )


def _lamp_points() -> np.ndarray:
    """Points [LAMP_RAYS, 3] spread over the lamp's disc."""
    k = np.arange(LAMP_RAYS)
    radius, angle = LAMP_RADIUS * np.sqrt((k + 0.5) / LAMP_RAYS), k * math.pi * (3 - math.sqrt(5))
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), np.zeros(LAMP_RAYS)), -1) + LAMP
