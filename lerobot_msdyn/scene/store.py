"""One camera's reconstruction on disk: its scenes, its camera and what was known of them (docs/scenes.md)."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from safetensors.torch import save as save_tensors
from torch import Tensor

from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.files import write_whole, writing
from lerobot_msdyn.motion.field import DeformationField
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import Gaussians
from lerobot_msdyn.scene.overlay import Overlay
from lerobot_msdyn.scene.shading import Shading

FOLDER = Path("msdyn_scenes")  # inside an output dataset
FOLDER_SCHEMA = 1  # of the folder of one camera
SCENE_SCHEMA = 3  # of one scene's file
LEVEL_KINDS: dict[str, type] = {"bases": MotionLevel, "field": DeformationField}
_HEADER, _CAMERA, _WINDOW = "scene.json", "camera.safetensors", "window_{:03d}.safetensors"


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


def save(scene: SavedScene, root: Path) -> Path:
    """Write a scene below a folder of scenes, replacing one that is there; returns its own folder.

    Raises:
        OutputError: it cannot be written.
    """
    folder = camera_folder(root, scene.source.episode, scene.source.camera)
    partial = folder.with_name(f".{folder.name}.partial")
    camera = {
        "intrinsics": scene.camera.intrinsics.contiguous(),
        "world_from_camera": scene.camera.world_from_camera.contiguous(),
    }
    header = {
        "schema": FOLDER_SCHEMA,
        "source": asdict(scene.source),
        "frames": len(scene),
        "starts": list(scene.starts),
        "width": scene.camera.width,
        "height": scene.camera.height,
        "camera_origin": scene.camera.origin,
        "metric": scene.metric,
        "distance_m": scene.distance,
        "priors": scene.priors,
    }
    with writing(folder):
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        for number, window in enumerate(scene.windows):
            save_scene(window, partial / _WINDOW.format(number))
        write_whole(partial / _CAMERA, save_tensors(camera))
        (partial / _HEADER).write_text(json.dumps(header, indent=1), encoding="utf-8")
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
        camera = load_file(folder / _CAMERA)
        track = CameraTrack(
            camera["intrinsics"],
            camera["world_from_camera"],
            header["width"],
            header["height"],
            header["camera_origin"],
        )
        return SavedScene(
            source=SceneSource(**header["source"]),
            windows=tuple(load_scene(folder / _WINDOW.format(number)) for number in range(len(header["starts"]))),
            starts=tuple(header["starts"]),
            camera=track,
            metric=header["metric"],
            distance=header["distance_m"],
            priors=header["priors"],
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
    path = folder / _HEADER
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
        schema = header["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise MsdynError(
            f"{path}: not the header of a saved scene ({type(error).__name__}: {error}); docs/scenes.md has the format"
        ) from error
    if schema != FOLDER_SCHEMA:
        raise MsdynError(f"{path}: schema is {schema}; expected {FOLDER_SCHEMA}; make it again with --save_scenes true")
    return dict(header)


def scenes_root(folder: Path) -> Path:
    """The folder of scenes of an output dataset, or the folder itself where it is one.

    Raises:
        MsdynError: there are none.
    """
    for root in (folder / FOLDER, folder):
        if next(root.glob(f"episode_*/*/{_HEADER}"), None) is not None:
            return root
    raise MsdynError(
        f"no saved scenes in {folder}: expected {FOLDER}/episode_000000/<camera>/{_HEADER}; "
        "they are kept by `python -m lerobot_msdyn.augment ... --save_scenes true`"
    )


def list_scenes(folder: Path) -> dict[int, dict[str, Path]]:
    """Source episode -> camera -> the folder of its scene; `folder` is an output dataset or its folder of scenes.

    Raises:
        MsdynError: there are none.
    """
    found: dict[int, dict[str, Path]] = {}
    for header in sorted(scenes_root(folder).glob(f"episode_*/*/{_HEADER}")):
        episode = int(header.parent.parent.name.removeprefix("episode_"))
        found.setdefault(episode, {})[header.parent.name] = header.parent
    return found


def save_scene(scene: DynamicScene, path: Path) -> None:
    """Write a scene as one safetensors file, atomically."""
    names = {kind: name for name, kind in LEVEL_KINDS.items()}
    header = {
        "schema": SCENE_SCHEMA,
        "levels": [names[type(level)] for level in scene.levels],
        "frames": scene.frames,
        "near": scene.near,
    }
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in scene.tensors().items()}
    write_whole(path, save_tensors(tensors, metadata={"lerobot_msdyn": json.dumps(header)}))


def load_scene(path: Path) -> DynamicScene:
    """Read a scene that `save_scene` wrote.

    Raises:
        MsdynError: the file is absent, damaged, or of another schema.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("lerobot_msdyn", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, ValueError, SafetensorError) as error:
        raise MsdynError(f"{path}: not a readable scene file ({error})") from error
    if header.get("schema") != SCENE_SCHEMA:
        raise MsdynError(f"{path}: scene schema is {header.get('schema')}; expected {SCENE_SCHEMA}; fit it again")
    kinds = header.get("levels", [])

    def part(name: str, kind: type) -> dict[str, Tensor]:
        return {item.name: tensors[f"{name}.{item.name}"] for item in fields(kind)}

    try:
        return DynamicScene(
            static=Gaussians(**part("static", Gaussians)),
            moving=Gaussians(**part("moving", Gaussians)),
            levels=tuple(LEVEL_KINDS[kind](**part(f"levels.{i}", LEVEL_KINDS[kind])) for i, kind in enumerate(kinds)),
            indices=tuple(tensors[f"levels.{i}.indices"] for i in range(len(kinds))),
            logits=tuple(tensors[f"levels.{i}.logits"] for i in range(len(kinds))),
            frames=header["frames"],
            shading=Shading(**part("shading", Shading)) if "shading.field" in tensors else None,
            near=header["near"],
            overlay=Overlay(**part("overlay", Overlay)) if "overlay.first" in tensors else None,
        )
    except KeyError as error:
        raise MsdynError(f"{path}: not a readable scene file ({error} is missing)") from error
