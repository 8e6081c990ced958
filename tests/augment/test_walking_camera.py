"""A camera that moves, end to end: new episodes are seen from one that moves as it did, displaced."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from augment_command import FRONT, run
from lerobot.datasets import LeRobotDataset
from walking import HEIGHT, WIDTH, walk

from lerobot_msdyn import viewer
from lerobot_msdyn.core.cameras import CameraTrack
from lerobot_msdyn.core.geometry import invert_se3
from lerobot_msdyn.evaluate.metrics import masked_psnr_db
from lerobot_msdyn.scene import store
from lerobot_msdyn.scene.ply import export_frames, load_ply
from lerobot_msdyn.scene.store import SavedScene
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.synthetic.scene import SyntheticScene
from lerobot_msdyn.training import MixedViews
from lerobot_msdyn.training.live import LiveScene
from lerobot_msdyn.views.perturbations.jitter import Jitter

PATH = ["--fit.steps", "60", "--scene.moving_frames", "6", "--variants", "1", "--fill", "none"]


@pytest.fixture(scope="module")
def augmented(tmp_path_factory: pytest.TempPathFactory) -> tuple[SyntheticScene, Path]:
    """A scene that was recorded by hand with depth and known poses, and the output of the command."""
    folder = tmp_path_factory.mktemp("walk")
    scene, view, _ = walk()
    scene = dataclasses.replace(scene, cameras={"front": view.camera})
    write_dataset([scene], "local/walk", folder / "walk", depth=True)
    poses = view.camera.camera_from_world.numpy()
    np.savez(folder / "poses.npz", K=view.camera.intrinsics.numpy(), w2c=poses, size=[HEIGHT, WIDTH])
    source = ["--repo", "local/walk", "--root", str(folder / "walk"), "--new_root", str(folder / "new")]
    camera = ["--allow_moving", "true", "--camera.poses", str(folder / "poses.npz"), "--save_scenes", "true"]
    change = ["--perturbation.type", "translation", "--perturbation.translation_m", "0.04"]
    assert run(*source, *camera, *change, *PATH) == 0
    return scene, folder / "new"


def new_camera(scene: SyntheticScene, out: Path) -> CameraTrack:
    """That of the new episode, as the output says."""
    view = json.loads(pq.read_table(out / "meta" / "msdyn" / "episodes.parquet").to_pylist()[1]["views"])[FRONT]
    offset = invert_se3(torch.tensor(view["camera_from_source"]))
    assert offset.shape == (4, 4)  # one for the episode
    assert 0.001 < offset[:3, 3].norm() < 0.08
    return dataclasses.replace(scene.camera, world_from_camera=scene.camera.world_from_camera @ offset)


def test_the_new_episode_is_seen_from_a_camera_that_moves_as_the_recorded_one_did(
    augmented: tuple[SyntheticScene, Path],
) -> None:
    scene, out = augmented
    new = LeRobotDataset("local/new", root=out, episodes=[1], video_backend="pyav")
    truth = scene.render(new_camera(scene, out)).rgb.numpy()
    recorded = scene.render(scene.camera).rgb.numpy()
    better = []
    for t in (0, 5, 9):
        picture = (new[t][FRONT].permute(1, 2, 0) * 255).round().byte().numpy()
        inside = (picture.max(-1) > 8).astype(np.float64)
        better.append(masked_psnr_db(picture, truth[t], inside) - masked_psnr_db(recorded[t], truth[t], inside))
    assert min(better) > 2


def test_its_scene_is_kept_with_its_poses(augmented: tuple[SyntheticScene, Path]) -> None:
    scene, out = augmented
    saved: SavedScene = store.load(store.list_scenes(out)[0][FRONT])
    assert not saved.camera.is_static
    away = (saved.camera.world_from_camera - scene.camera.world_from_camera)[:, :3, 3].norm(dim=-1)
    assert away.max() < 0.01  # m: they are refined
    frames = torch.tensor([2, 8])
    live = LiveScene(saved).render(saved.camera.select(frames), frames)
    truth = scene.render(scene.camera).rgb[frames].permute(0, 3, 1, 2).numpy()
    error = np.square((live.rgb.astype(float) - truth) / 255).mean()
    assert -10 * np.log10(error) > 18  # dB


def test_the_gate_has_judged_it(augmented: tuple[SyntheticScene, Path]) -> None:
    scene, out = augmented
    recorded, new = pq.read_table(out / "meta" / "msdyn" / "episodes.parquet").to_pylist()
    assert json.loads(recorded["gate"]).get("views", {}) == {}
    view = json.loads(new["gate"])["views"][FRONT]
    assert not view["camera"]["stands"]
    assert view["camera"]["path_m"] == pytest.approx(scene.camera.path_length, rel=0.1)
    assert f"it moves along {view['camera']['path_m']:.2f} m" in (out / "report.html").read_text()
    scores = view["scores"]
    assert 14 < scores["expected_db"] < 45
    assert 0 < scores["unseen"] < 0.2
    assert all(0 < frame["angle_deg"] < 10 for frame in scores["frames"])


def test_samples_in_training_are_seen_along_its_path(augmented: tuple[SyntheticScene, Path]) -> None:
    _, out = augmented
    dataset = LeRobotDataset("local/walk", root=out.parent / "walk", video_backend="pyav")
    still = MixedViews(dataset, out, 1.0, Jitter(translation_m=0.0, translation_rel=0.0, rotation_deg=0.0))
    moved = MixedViews(dataset, out, 1.0, Jitter(rotation_deg=6.0))
    for t in (0, 5, 9):
        recorded = dataset[t][FRONT]
        same, other = ((mixed[t][FRONT] - recorded).square().mean() for mixed in (still, moved))
        assert same < 10**-1.8  # 18 dB
        assert other > 2 * same
    assert (dataset[0][FRONT] - dataset[9][FRONT]).square().mean() > 10**-1.8, "it has moved on"


def test_what_stands_still_stays_in_frames_of_ply(augmented: tuple[SyntheticScene, Path], tmp_path: Path) -> None:
    _, out = augmented
    saved: SavedScene = store.load(store.list_scenes(out)[0][FRONT])
    saved = dataclasses.replace(saved, windows=tuple(part.without_patches() for part in saved.windows))
    first, last = (load_ply(path) for path in export_frames(saved, [0, 9], tmp_path))
    still = len(saved.windows[0].static)
    assert still > 1000
    torch.testing.assert_close(first.means[:still], last.means[:still])
    assert not torch.equal(first.means[still:][:100], last.means[still:][:100])


def test_the_viewer_moves_the_camera(
    augmented: tuple[SyntheticScene, Path],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("rerun")
    logged: dict[str, set[int]] = {}
    at = viewer._Log.at

    def counted(log: viewer._Log, frame: int, path: str, what: object) -> None:
        logged.setdefault(path, set()).add(frame)
        at(log, frame, path, what)

    monkeypatch.setattr(viewer._Log, "at", counted)
    _, out = augmented
    source = ["--repo", "local/walk", "--root", str(out.parent / "walk"), "--scenes", str(out)]
    assert viewer.run([*source, "--episode", "0", "--variants", "1", "--save", str(tmp_path / "walk.rrd")]) == 0
    assert "taken as fixed" not in caplog.text
    for camera in ("source", "new_0"):
        assert len(logged[f"world/cameras/{camera}"]) >= 10, "a place per frame"
