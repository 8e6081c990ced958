"""One camera's reconstruction on disk: its scenes, its camera and what was known of them (docs/scene.md)."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from safetensors import SafetensorError
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.config import RIVAL_LEVELS
from lerobot_msdyn.core.errors import ConfigError, MsdynError
from lerobot_msdyn.core.files import writing
from lerobot_msdyn.core.perturbation import LEVEL
from lerobot_msdyn.core.serialise import from_named_tensors, named_tensors, read_tensors, save_value, write_tensors
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.spec import level_spec
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.folders import FOLDER as FOLDER
from lerobot_msdyn.scene.folders import HEADER
from lerobot_msdyn.scene.folders import list_scenes as list_scenes
from lerobot_msdyn.scene.folders import scenes_root as scenes_root
from lerobot_msdyn.scene.gaussians import Gaussians
from lerobot_msdyn.scene.overlay import Overlay
from lerobot_msdyn.scene.shading import Shading
from lerobot_msdyn.scene.short_lived import ShortLived

FOLDER_SCHEMA = 1  # of the folder of one camera
SCENE_SCHEMA = 4  # of one scene's file
_WITHOUT_SHORT_LIVED = 3  # of one that has none of them: what earlier versions read
_SCENE_HEADER = "lerobot_msdyn"
_CAMERA, _WINDOW = "camera.safetensors", "window_{:03d}.safetensors"


@dataclass(frozen=True)
class SceneSource:
    """The video that a scene was reconstructed from."""

    repo_id: str
    episode: int
    camera: str  # feature key
    fps: int


@dataclass(frozen=True)
class SavedScene:
    """One camera's scenes, one per window of its video, and what a new view of them needs."""

    source: SceneSource
    windows: tuple[DynamicScene, ...]
    starts: tuple[int, ...]  # first frame of each window
    camera: CameraTrack  # at the size of the recorded video
    metric: bool  # whether depth is in true metres
    distance: float  # m, to the look-at point
    priors: Mapping[str, Mapping[str, str]]  # prior -> provider, why, model and licence
    up: tuple[float, float, float] = LEVEL  # the vertical in the axes of the camera at the first frame

    def __len__(self) -> int:
        return len(self.camera)

    @property
    def size_in_bytes(self) -> int:
        """Memory of all tensors."""
        return sum(tensor.nbytes for window in self.windows for tensor in window.tensors().values())

    def windows_of(self, frames: Int[Tensor, " b"]) -> Int[Tensor, " b"]:
        """The window that each frame lies in."""
        return torch.searchsorted(torch.tensor(self.starts), frames, right=True) - 1


def camera_folder(root: Path, episode: int, camera: str) -> Path:
    """Where the scene of one camera of one source episode lies below a folder of scenes."""
    return root / f"episode_{episode:06d}" / camera


def save(scene: SavedScene, root: Path, beside: Mapping[str, object] | None = None) -> Path:
    """Write a scene below a folder of scenes, replacing one that is there; returns its own folder.

    `beside`: further values (`serialise.save_value`) in that folder, by the names of their files.

    Raises:
        OutputError: it cannot be written.
    """
    folder = camera_folder(root, scene.source.episode, scene.source.camera)
    partial = folder.with_name(f".{folder.name}.partial")
    header = {
        "schema": FOLDER_SCHEMA,
        "source": asdict(scene.source),
        "frames": len(scene),
        "starts": list(scene.starts),
        "width": scene.camera.width,
        "height": scene.camera.height,
        "camera_origin": scene.camera.origin,
        "camera_world": scene.camera.world,
        "metric": scene.metric,
        "distance_m": scene.distance,
        "up": list(scene.up),
        "priors": scene.priors,
    }
    with writing(folder):
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        for number, window in enumerate(scene.windows):
            save_scene(window, partial / _WINDOW.format(number))
        write_tensors(partial / _CAMERA, named_tensors(scene.camera))
        for name, value in (beside or {}).items():
            save_value(partial / name, value, partial)
        (partial / HEADER).write_text(json.dumps(header, indent=1), encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)
        partial.rename(folder)
    return folder


def load(folder: Path) -> SavedScene:
    """Read the scene of one camera from its own folder.

    Raises:
        MsdynError: a file is absent, damaged or of another schema.
    """
    header = read_header(folder)
    try:
        camera, _ = read_tensors(folder / _CAMERA)
        track = CameraTrack(
            camera["intrinsics"],
            camera["world_from_camera"],
            header["width"],
            header["height"],
            header["camera_origin"],
            header.get("camera_world", "calibration" if header["camera_origin"] == "calibration" else ""),
        )
        return SavedScene(
            source=SceneSource(**header["source"]),
            windows=tuple(load_scene(folder / _WINDOW.format(number)) for number in range(len(header["starts"]))),
            starts=tuple(header["starts"]),
            camera=track,
            metric=header["metric"],
            distance=header["distance_m"],
            priors=header["priors"],
            up=tuple(header.get("up", SavedScene.up)),  # scenes of earlier versions do not say
        )
    except (OSError, KeyError, TypeError, SafetensorError) as error:
        raise MsdynError(
            f"{folder}: not a readable saved scene ({type(error).__name__}: {error}); "
            "make it again with `augment --save_scenes true`"
        ) from error


def read_header(folder: Path) -> dict[str, Any]:
    """What `scene.json` of one camera's folder says.

    Raises:
        MsdynError: it is absent, damaged or of another schema.
    """
    path = folder / HEADER
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
        schema = header["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise MsdynError(
            f"{path}: not the header of a saved scene ({type(error).__name__}: {error}); docs/scene.md has the format"
        ) from error
    if schema != FOLDER_SCHEMA:
        raise MsdynError(f"{path}: schema is {schema}; expected {FOLDER_SCHEMA}; make it again with --save_scenes true")
    return dict(header)


def save_scene(scene: DynamicScene, path: Path) -> None:
    """Write a scene as one safetensors file, atomically."""
    header = {
        "schema": _WITHOUT_SHORT_LIVED if scene.short_lived is None else SCENE_SCHEMA,
        "levels": [level.kind for level in scene.levels],
        "frames": scene.frames,
        "near": scene.near,
    }
    write_tensors(path, scene.tensors(), {_SCENE_HEADER: json.dumps(header)})


def load_scene(path: Path) -> DynamicScene:
    """Read a scene that `save_scene` wrote.

    Raises:
        MsdynError: the file is absent, damaged, of another schema, or holds a motion level that is not registered.
    """
    try:
        tensors, metadata = read_tensors(path)
        header = json.loads(metadata.get(_SCENE_HEADER, "{}"))
    except (OSError, ValueError, SafetensorError) as error:
        raise MsdynError(f"{path}: not a readable scene file ({error})") from error
    if header.get("schema") not in (_WITHOUT_SHORT_LIVED, SCENE_SCHEMA):
        raise MsdynError(f"{path}: scene schema is {header.get('schema')}; expected {SCENE_SCHEMA}; fit it again")
    kinds = [_level_class(path, kind) for kind in header.get("levels", [])]

    def part[T](name: str, kind: type[T]) -> T:
        return from_named_tensors(kind, tensors, name)

    try:
        return DynamicScene(
            static=part("static", Gaussians),
            moving=part("moving", Gaussians),
            levels=tuple(part(f"levels.{i}", kind) for i, kind in enumerate(kinds)),
            indices=tuple(tensors[f"levels.{i}.indices"] for i in range(len(kinds))),
            logits=tuple(tensors[f"levels.{i}.logits"] for i in range(len(kinds))),
            frames=header["frames"],
            shading=part("shading", Shading) if "shading.field" in tensors else None,
            near=header["near"],
            short_lived=part("short_lived", ShortLived) if "short_lived.first" in tensors else None,
            overlay=part("overlay", Overlay) if "overlay.first" in tensors else None,
        )
    except KeyError as error:
        raise MsdynError(f"{path}: not a readable scene file ({error} is missing)") from error


def _level_class(path: Path, kind: str) -> type:
    """The class of a kind of motion level, which is that of the level that registers it."""
    if kind == MotionLevel.kind:
        return MotionLevel
    try:
        return level_spec(kind).value
    except ConfigError as error:
        raise MsdynError(
            f"{path}: its motion is of kind {kind!r}, which is not registered; "
            f"add --plugins {RIVAL_LEVELS.get(kind, 'FILE.py')}, or import the module that registers it"
        ) from error
