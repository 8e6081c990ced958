"""Scenes saved and loaded: all that they hold, and files of earlier versions."""

import dataclasses
import json
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor

from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.registries import MOTION_LEVELS
from lerobot_msdyn.core.serialise import load_value, save_value
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.spec import Binding, FirstLevel
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import isotropic
from lerobot_msdyn.scene.shading import encode_gain, no_shading
from lerobot_msdyn.scene.store import list_scenes, load, load_scene, save, save_scene


def test_a_saved_scene_comes_back(scene_with_two_parts: DynamicScene, tmp_path: Path) -> None:
    scene = scene_with_two_parts
    save_scene(scene, tmp_path / "scene.safetensors")
    again = load_scene(tmp_path / "scene.safetensors")
    frames = torch.arange(3)
    for name in ("means", "quats", "scales", "opacities", "rgb", "moving"):
        assert torch.equal(getattr(scene.at(frames), name), getattr(again.at(frames), name))
    assert again.frames == 3
    assert [path.name for path in tmp_path.iterdir()] == ["scene.safetensors"]


@dataclasses.dataclass(frozen=True)
class Drift:
    """Motion of a kind of its own: everything moves alike."""

    kind: ClassVar[str] = "drift"

    per_frame: Float[Tensor, "3"]  # m

    def carry(self, positions, orientations, indices, logits, times) -> tuple:
        return self.carry_points(positions, indices, logits, times), orientations

    def carry_points(self, positions, indices, logits, times) -> Tensor:
        return positions + times[:, None, None] * self.per_frame


@MOTION_LEVELS.register("drift")
class Drifting(FirstLevel):
    value = Drift

    def estimate(self, tracks, config) -> Drift:
        raise NotImplementedError

    def bind(self, level, points, part, coarser) -> Binding:
        raise NotImplementedError


@pytest.mark.parametrize("files", ["scene", "any value"])
def test_all_kinds_of_levels_come_back(scene_with_two_parts: DynamicScene, tmp_path: Path, files: str) -> None:
    scene, nothing = scene_with_two_parts, torch.zeros(3, 0)
    scene = dataclasses.replace(
        scene,
        levels=(*scene.levels, Drift(torch.tensor([0.0, 0.5, 0.0]))),
        indices=(*scene.indices, nothing.long()),
        logits=(*scene.logits, nothing),
        moving=isotropic(scene.moving),
    )
    path = tmp_path / "scene.safetensors"
    if files == "scene":
        save_scene(scene, path)
        again = load_scene(path)
    else:  # as an unfinished run keeps it
        save_value(path, scene, tmp_path)
        again = load_value(path, tmp_path)
    assert [type(level) for level in again.levels] == [MotionLevel, Drift]
    still = dataclasses.replace(scene, levels=scene.levels[:1], indices=scene.indices[:1], logits=scene.logits[:1])
    frames = torch.tensor([0, 2])
    assert torch.equal(again.at(frames).means, scene.at(frames).means)
    assert not torch.equal(again.at(frames).means, still.at(frames).means)
    assert torch.equal(again.at(frames).scales, scene.at(frames).scales)


def test_motion_of_an_unknown_kind_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    header = json.dumps({"schema": 3, "near": 0.01, "levels": ["swirl"], "frames": 3})
    save_file({"static.means": torch.zeros(1, 3)}, path, metadata={"lerobot_msdyn": header})
    with pytest.raises(MsdynError, match=r"scene\.safetensors: its motion is of kind 'swirl'.*--plugins FILE\.py"):
        load_scene(path)


# A scene as the first version of this format wrote it, with all that there can be, array by array.
QUATS = torch.tensor([[1.0, 0, 0, 0]])
UNTURNED = torch.tensor([1.0, 0, 0, 0, 1, 0])
OLD_HEADER = {"schema": 3, "levels": ["bases"], "frames": 2, "near": 0.25}
OLD_ARRAYS = {
    "static.means": torch.tensor([[0.0, 0, 3]]),
    "static.quats": QUATS,
    "static.log_scales": torch.full((1, 3), -2.0),
    "static.opacity_logits": torch.tensor([1.5]),
    "static.sh": torch.zeros(1, 1, 3),
    "moving.means": torch.tensor([[0.0, 0, 1], [0.5, 0, 1]]),
    "moving.quats": QUATS.repeat(2, 1),
    "moving.log_scales": torch.full((2, 1), -3.0),  # isotropic
    "moving.opacity_logits": torch.tensor([0.5, 2.0]),
    "moving.sh": torch.full((2, 4, 3), 0.1),
    "levels.0.rotations_6d": UNTURNED.repeat(2, 2, 1),
    "levels.0.displacements": torch.tensor([[[0.0, 0, 0], [0, 0, 0]], [[0.0, 0, 0], [1.0, 0, 0]]]),
    "levels.0.knots": torch.tensor([0.0, 1.0]),
    "levels.0.pivots": torch.zeros(2, 3),
    "levels.0.reach": torch.ones(2),
    "levels.0.parents": torch.tensor([-1, -1]),
    "levels.0.active": torch.tensor([False, True]),
    "levels.0.indices": torch.tensor([[0], [1]]),
    "levels.0.logits": torch.zeros(2, 1),
    "shading.field": torch.full((2, 1, 1), 128, dtype=torch.uint8),
    "shading.places": torch.zeros(1, 2),
    "shading.moving": torch.tensor([[128, 128], [128, 255]], dtype=torch.uint8),
    "overlay.first": torch.tensor([0, 0, 1]),
    "overlay.means": torch.tensor([[0.0, 0.25, 1]]),
    "overlay.quats": QUATS.half(),
    "overlay.log_scales": torch.full((1, 3), -4.0).half(),
    "overlay.rgb": torch.tensor([[1.0, 0.5, 0.25]]).half(),
    "overlay.hidden": torch.tensor([[0], [0b10000000]], dtype=torch.uint8),
}


def test_a_scene_of_an_earlier_version_is_read(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    save_file(OLD_ARRAYS, path, metadata={"lerobot_msdyn": json.dumps(OLD_HEADER)})
    scene = load_scene(path)
    assert (scene.frames, scene.near) == (2, 0.25)
    at_end = scene.at(torch.tensor([1]))
    torch.testing.assert_close(at_end.means[0], torch.tensor([[0.0, 0, 3], [0, 0, 1], [1.5, 0, 1]]))
    torch.testing.assert_close(at_end.scales[:, 1].log(), torch.tensor([-2.0, -3.0, -3.0]))
    grey = 0.5 + 0.28209479177387814 * 0.1
    torch.testing.assert_close(at_end.rgb[0, :, 0], torch.tensor([0.5, grey, 2 * grey]))
    assert scene.overlay is not None
    patch = scene.overlay.patch(1, 3)
    assert patch.hidden.tolist() == [True, False, False]
    assert patch.rgb.tolist() == [[1.0, 0.5, 0.25]]
    assert len(scene.overlay.patch(0, 3)) == 0


def test_an_earlier_version_reads_what_is_written(tmp_path: Path) -> None:
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    save_file(OLD_ARRAYS, first, metadata={"lerobot_msdyn": json.dumps(OLD_HEADER)})
    save_scene(load_scene(first), second)
    assert second.read_bytes() == first.read_bytes()


def test_a_folder_of_an_earlier_version_is_read(tmp_path: Path) -> None:
    folder = tmp_path / "episode_000003" / "observation.images.front"
    folder.mkdir(parents=True)
    header = {
        "schema": 1,
        "source": {"repo_id": "local/desk", "episode": 3, "camera": "observation.images.front", "fps": 30},
        "frames": 4,
        "starts": [0, 2],
        "width": 64,
        "height": 48,
        "camera_origin": "calibration",
        "metric": True,
        "distance_m": 0.75,
        "priors": {"depth": {"provider": "recorded"}},
    }
    (folder / "scene.json").write_text(json.dumps(header))
    camera = {"intrinsics": torch.eye(3).repeat(4, 1, 1), "world_from_camera": torch.eye(4).repeat(4, 1, 1)}
    save_file(camera, folder / "camera.safetensors")
    for number in range(2):
        path = folder / f"window_{number:03d}.safetensors"
        save_file(OLD_ARRAYS, path, metadata={"lerobot_msdyn": json.dumps(OLD_HEADER)})
    scene = load(list_scenes(tmp_path)[3]["observation.images.front"])
    assert (scene.source.fps, scene.starts, scene.metric, scene.distance) == (30, (0, 2), True, 0.75)
    assert (len(scene), scene.camera.width, scene.camera.origin) == (4, 64, "calibration")
    assert scene.camera.world == "calibration"
    assert torch.equal(scene.camera.intrinsics, camera["intrinsics"])
    again = save(scene, tmp_path / "again")
    for file in sorted(folder.iterdir()):
        written = (again / file.name).read_bytes()
        made = header | {"camera_world": "calibration", "up": [0.0, -1.0, 0.0]}
        same = json.loads(written) == made if file.suffix == ".json" else written == file.read_bytes()
        assert same, file.name


def test_a_scene_without_some_of_its_arrays_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    header = '{"schema": 3, "near": 0.01, "levels": ["bases"], "frames": 3}'
    save_file({"static.means": torch.zeros(1, 3)}, path, metadata={"lerobot_msdyn": header})
    with pytest.raises(MsdynError, match=r"not a readable scene file .*is missing"):
        load_scene(path)


def test_shading_is_saved_too(scene_with_two_parts: DynamicScene, tmp_path: Path) -> None:
    scene = scene_with_two_parts
    gains = torch.tensor([[1.0, 1.0, 1.0], [0.5, 1.0, 2.0], [1.0, 1.0, 1.0]])
    shading = dataclasses.replace(no_shading(2, 3, 3), moving=encode_gain(gains))
    save_scene(dataclasses.replace(scene, shading=shading), tmp_path / "scene.safetensors")
    again = load_scene(tmp_path / "scene.safetensors").at(torch.tensor([1]))
    torch.testing.assert_close(again.rgb[0, :2], scene.static.rgb)
    torch.testing.assert_close(again.rgb[0, 2:], scene.moving.rgb * gains[1, :, None], atol=0.01, rtol=0)


def test_what_is_no_scene_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    with pytest.raises(MsdynError, match="not a readable scene file"):
        load_scene(path)
    path.write_bytes(b"nothing")
    with pytest.raises(MsdynError, match="not a readable scene file"):
        load_scene(path)
    save_file({"a": torch.zeros(1)}, path, metadata={"lerobot_msdyn": '{"schema": 99}'})
    with pytest.raises(MsdynError, match="scene schema is 99; expected 4"):
        load_scene(path)
