"""Which provider is chosen, why, and what it hands on; whole clips with small models of random weights."""

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from huggingface_hub import constants

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import CameraConfig, PriorsConfig
from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import BodyTracks, RobotSeen, View
from lerobot_msdyn.priors import Priors, estimate_masks, estimate_priors
from lerobot_msdyn.priors.camera.steadiness import camera_motion_px
from lerobot_msdyn.priors.depth.table_plane import ground_plane
from lerobot_msdyn.priors.exchange import Exchange, write_exchange
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.viewpoints import hand_held_camera

FRAMES = 12


@pytest.fixture(autouse=True)
def nothing_cached(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without learned models."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path_factory.mktemp("hub")))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path_factory.mktemp("torch")))


@pytest.fixture(scope="module")
def view(sliding) -> View:
    """A block that slides before a wall two metres away, itself one metre away; with recorded depth."""
    rgb, mask = sliding.rgb[6 : 6 + FRAMES], sliding.mask[6 : 6 + FRAMES]
    depth = torch.where(mask, 1.0, 2.0)
    return View(rgb, static_camera(intrinsics_from_fov(96, 72, 60.0), FRAMES, 96, 72), depth, (0.01, 10.0))


def estimate(view: View, camera: CameraConfig | None = None, **config: object) -> Priors:
    return estimate_priors(view, PriorsConfig(**config), camera or CameraConfig(), episode=0, key="front")  # type: ignore[arg-type]


def test_other_episodes_show_the_masks_what_this_one_hides(view: View, sliding) -> None:
    resting = View(view.rgb[:1].expand(FRAMES, -1, -1, -1).contiguous(), view.camera)
    assert not estimate(resting).instances.any()
    empty = torch.from_numpy(sliding.empty.round().astype(np.uint8))
    elsewhere = empty.expand(3 * FRAMES, -1, -1, -1).contiguous()
    found = estimate_priors(resting, PriorsConfig(), CameraConfig(), elsewhere=elsewhere).instances > 0
    mask = sliding.mask[6]
    assert (found[0] & mask).sum() > 0.9 * mask.sum()
    assert found[0].sum() < 2 * mask.sum()


def test_auto_takes_what_is_at_hand_and_says_why(view: View, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        priors = estimate(view)
    said = {record.message.split(":")[0]: record.message for record in caplog.records}
    assert "recorded: the dataset has it" in said["depth"]
    assert re.search(r"change: the model \S+ is not on this machine, the model \S+ .*, 1 instances$", said["masks"])
    assert "flow: RAFT's weights are not on this machine" in said["tracks"]
    assert "fixed: the picture keeps still" in said["camera"]
    assert all("\n" not in line for line in said.values())
    assert priors.metric
    assert {prior: entry["provider"] for prior, entry in priors.provenance.items()} == {
        "camera": "fixed",
        "masks": "change",
        "depth": "recorded",
        "tracks": "flow",
    }
    plane = estimate(replace(view, depth=None))
    assert not plane.metric
    assert plane.provenance["depth"]["provider"] == "plane"
    why = plane.provenance["depth"]["why"]
    assert re.match(r"no depth is recorded, the model \S+ is not on this machine, .*, no other camera", why)
    assert why.endswith("; a table seen from 0.5 m at 35 degrees")


def test_a_second_run_reads_what_the_first_has_kept(view: View, tmp_path: Path, caplog) -> None:
    first = estimate(view, cache=str(tmp_path))
    with caplog.at_level(logging.DEBUG):
        second = estimate(view, cache=str(tmp_path))
    assert sum("taken from" in record.message for record in caplog.records) == 2
    assert torch.equal(first.instances, second.instances)
    assert torch.equal(first.tracks.xy, second.tracks.xy)


def test_depth_that_holds_nothing_is_named_and_auto_goes_on(view: View, caplog: pytest.LogCaptureFixture) -> None:
    assert view.depth is not None
    empty = replace(view, depth=torch.zeros_like(view.depth))
    with pytest.raises(PriorError, match="recorded depth of front holds no measurement in any of its 12 frames"):
        estimate(empty, depth="recorded")
    with caplog.at_level(logging.WARNING):
        priors = estimate(empty)
    assert priors.provenance["depth"]["provider"] == "plane"
    assert "recorded cannot be used" in caplog.text


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            {"depth": "depth_anything"},
            "is 'depth_anything', but .*: python -m lerobot_msdyn.models fetch depth_anything$",
        ),
        ({"depth": "depth_anything_metric"}, "models fetch depth_anything_metric$"),
        ({"masks": "sam2"}, "priors.masks is 'sam2', but .*models fetch sam2$"),
        ({"masks": "edgetam"}, "models fetch edgetam$"),
        ({"tracks": "raft"}, "'raft', but RAFT's weights are not on this machine; fetch: .*models fetch raft$"),
        ({"depth": "stereo"}, "priors.depth is 'stereo', but no other camera of the episode is read"),
        ({"depth": "absent.npz"}, "absent.npz: not a readable npz file"),
    ],
)
def test_what_was_asked_for_and_is_absent_is_named(view: View, config: dict[str, str], message: str) -> None:
    with pytest.raises(PriorError, match=message):
        estimate(view, None, **config)


def test_recorded_depth_must_be_there(view: View) -> None:
    with pytest.raises(PriorError, match="no <camera>_depth feature"):
        estimate(replace(view, depth=None), depth="recorded")


def exchange(path: Path, **arrays: object) -> str:
    np.savez(path, **{name: np.asarray(value) for name, value in arrays.items()})  # type: ignore[arg-type]
    return str(path)


def test_everything_from_an_exchange_file(view: View, tmp_path: Path) -> None:
    masks = np.zeros((FRAMES, 72, 96), np.uint8)
    masks[:, 20:40, 10:30] = 1
    xy = np.full((3, FRAMES, 2), 25.0, np.float32)
    xy[1], xy[2] = 90.0, -5.0  # on the background, and outside
    assert view.depth is not None
    file = exchange(
        tmp_path / "front_0.npz",
        masks=masks,
        depth=4 / view.depth.numpy() + 1,
        depth_kind="affine_disparity",
        tracks=xy,
        vis=np.ones((3, FRAMES), bool),
        K=np.array([[80.0, 0, 48], [0, 80, 36], [0, 0, 1]]),
        w2c=np.tile(np.eye(4), (FRAMES, 1, 1)),
        world="cell",
        provenance='{"depth": {"model": "some/model", "licence": "MIT"}}',
    ).replace("front_0", "{camera}_{episode}")
    priors = estimate(view, CameraConfig(poses=file), depth=file, masks=file, tracks=file)
    assert torch.equal(priors.instances, torch.from_numpy(masks))
    assert len(priors.tracks) == 1
    assert priors.camera is not None
    assert (float(priors.camera.intrinsics[0, 0, 0]), priors.camera.origin) == (80.0, "exchange")
    assert priors.camera.world == "cell"
    assert priors.provenance["depth"]["model"] == "some/model"
    assert "scaled and shifted to recorded" in priors.provenance["depth"]["why"]
    known = priors.depth > 0
    torch.testing.assert_close(priors.depth[known], view.depth[known], atol=1e-2, rtol=0)
    assert known.float().mean() > 0.9


def test_metres_of_a_file_give_way_to_a_ground_that_is_known(view: View, tmp_path: Path) -> None:
    down = torch.tensor(40.0).deg2rad()
    right, ahead = torch.tensor([1.0, 0, 0]), torch.stack((torch.zeros(()), down.cos(), -down.sin()))
    pose = torch.eye(4)
    pose[:3] = torch.stack((right, torch.linalg.cross(ahead, right), ahead, torch.tensor([0.0, 0, 0.5])), dim=1)
    camera = replace(view.camera, world_from_camera=pose.expand(FRAMES, 4, 4).contiguous(), origin="calibration")
    ground = ground_plane(camera, 0.0)
    bias = 1 + 0.03 * torch.linspace(0, 6.3, 96).sin()
    file = exchange(tmp_path / "metres.npz", depth=(ground * bias).expand(FRAMES, -1, -1).numpy())
    unmoved = torch.zeros(FRAMES, 72, 96)
    nothing = BodyTracks(torch.zeros(0, FRAMES, 3), torch.zeros(0, FRAMES) > 0, torch.zeros(0).long())
    above = replace(view, depth=None, camera=camera)
    known = replace(above, robot=RobotSeen(unmoved, unmoved > 0, nothing, 0.0))
    table = (ground < ground.max()).expand(FRAMES, -1, -1) & ~(estimate(above, depth=file).instances > 0)
    off = []
    for seen in (above, known):
        priors = estimate(seen, depth=file)
        off.append(float((priors.depth / ground - 1).abs()[table & (priors.depth > 0)].mean()))
    assert 0.015 < off[0] < 0.025  # as it is in the file
    assert off[1] < 0.002
    assert "metric; scaled to plane" in priors.provenance["depth"]["why"]


def test_what_a_file_lacks_is_named(view: View, tmp_path: Path) -> None:
    file = exchange(tmp_path / "x.npz", frames=FRAMES)
    for prior in ("depth", "masks", "tracks"):
        with pytest.raises(PriorError, match=rf"priors.{prior}: .*x\.npz has no array"):
            estimate(view, None, **{prior: file})
    with pytest.raises(PriorError, match="has neither K nor w2c"):
        estimate(view, CameraConfig(poses=file))


def test_learned_models_are_used_where_they_are_and_recorded(view: View, tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    from tiny_models import save_depth_anything, save_sam2

    relative, metric, sam2 = (str(tmp_path / name) for name in ("relative", "metric", "sam2"))
    save_depth_anything(Path(metric), "metric")
    save_sam2(Path(sam2))
    priors = estimate(replace(view, depth=None), depth_anything_metric_model=metric, sam2_model=sam2)
    depth, masks = priors.provenance["depth"], priors.provenance["masks"]
    assert (depth["provider"], depth["model"], depth["revision"]) == ("depth_anything_metric", metric, "local")
    assert "in the network's own metres" in depth["why"]
    assert (masks["provider"], masks["model"], masks["licence"]) == ("sam2", sam2, "unknown: read its model card")
    scaled = estimate(view, depth="depth_anything_metric", depth_anything_metric_model=metric)
    assert "scaled to recorded" in scaled.provenance["depth"]["why"]
    assert scaled.metric
    with pytest.raises(PriorError, match="predicts metric"):
        estimate(view, depth="depth_anything", depth_anything_model=metric)
    assert not Path(relative).exists()


def test_the_field_of_view_is_not_searched_on_a_plane(view: View) -> None:
    with pytest.raises(PriorError, match="needs depth that does not depend on the field of view"):
        estimate(view, CameraConfig(fov_search=True), depth="plane")


def test_before_a_camera_that_is_said_to_move_a_slow_way_is_no_sway() -> None:
    width, height, frames = 160, 120, 24
    camera = hand_held_camera(frames, width, height, 10.0)
    seen = make_scene("push", 0, frames, width, height).render(camera)
    assert 0.5 < camera_motion_px(seen.rgb) < 3
    fixed = View(seen.rgb, static_camera(camera.intrinsics[0], frames, width, height), seen.depth)
    moves = replace(fixed, camera=camera)
    masked = []
    for view, poses in ((fixed, "auto"), (fixed, "sfm"), (moves, "auto")):
        masks = estimate_masks(view, PriorsConfig(masks="change", cache="off"), CameraConfig(poses=poses)) > 0
        masked.append(float((masks & (seen.instances == 0)).float().mean()))
    assert masked[1] == masked[2] < 0.5 * masked[0]


def test_a_file_of_poses_tells_the_masks_whether_the_camera_moves(tmp_path: Path) -> None:
    width, height, frames = 160, 120, 24
    camera = hand_held_camera(frames, width, height, 10.0)
    seen = make_scene("push", 0, frames, width, height).render(camera)
    recorded = View(seen.rgb, static_camera(camera.intrinsics[0], frames, width, height), seen.depth)
    masked = {}
    for name, poses in (("walks", camera.camera_from_world.numpy()), ("stands", None)):
        content = Exchange(frames, height, width, K=camera.intrinsics.numpy(), w2c=poses)
        write_exchange(tmp_path / f"{name}.npz", content)
        config = PriorsConfig(masks="change", depth="plane", cache="off")
        found = estimate_priors(recorded, config, CameraConfig(poses=str(tmp_path / f"{name}.npz")))
        masked[name] = float(((found.instances > 0) & (seen.instances == 0)).float().mean())
    assert masked["walks"] < 0.5 * masked["stands"]
