"""The ray-cast scenes: their ground truth is true, and what they write is what LeRobot and scorers read."""

import json
import math
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from pictures import read_picture

from lerobot_msdyn.core.errors import ConfigError, OutputError
from lerobot_msdyn.core.geometry import invert_se3, project, transform_points, unproject_image
from lerobot_msdyn.synthetic import (
    SyntheticScene,
    SyntheticView,
    covisibility,
    heldout_cameras,
    make_scene,
    write_dataset,
    write_nvs_folder,
)
from lerobot_msdyn.synthetic.__main__ import run
from lerobot_msdyn.synthetic.choreography import BLOCK_HALF
from lerobot_msdyn.synthetic.intersect import BOX, CYLINDER, ELLIPSOID, SHEET, Geometry, hit
from lerobot_msdyn.synthetic.raycast import Appearance, Pinhole, see_points, trace_color, trace_surface

WIDTH, HEIGHT, FRAMES = 96, 72, 12


@pytest.fixture(scope="module")
def everything() -> SyntheticScene:
    return make_scene("all", 3, FRAMES, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def view(everything: SyntheticScene) -> SyntheticView:
    return everything.render(everything.camera)


def four_shapes() -> Geometry:
    """Shapes along x at z = 0; the sheet is a right angle: 1 m along -x, then 1 m up."""
    nodes = np.array([[10.0, 0, 0], [9.0, 0, 0], [9.0, 0, 1.0]])
    return Geometry(
        shape=np.array([BOX, CYLINDER, ELLIPSOID, SHEET]),
        half=np.array([[1.0, 2.0, 0.5], [0.5, 0.5, 1.0], [1.0, 2.0, 3.0], [2.0, 1.0, 0.0]]),
        radius=np.array([3.0, 2.0, 3.0, 2.0]),
        position=np.array([[0.0, 0, 0], [4.0, 0, 0], [7.0, 0, 0], [9.5, 0.5, 0.5]]),
        rotation=np.ascontiguousarray(np.broadcast_to(np.eye(3), (4, 3, 3))),
        casts_shadow=np.ones(4, bool),
        sheet_nodes=nodes,
        sheet_across=np.array([0.0, 1.0, 0.0]),
    )


@pytest.mark.parametrize(
    ("primitive", "origin", "direction", "expected"),
    [
        (0, (0.5, 0.5, 5.0), (0.0, 0.0, -1.0), 4.5),  # box from above
        (0, (0.5, 0.5, 5.0), (0.0, 0.0, -2.0), 2.25),  # t counts directions, not metres
        (0, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 2.0),  # from inside, as in a room
        (0, (1.5, 0.0, 5.0), (0.0, 0.0, -1.0), math.inf),
        (1, (4.3, 0.0, 5.0), (0.0, 0.0, -1.0), 4.0),  # cap
        (1, (4.0, -5.0, 0.5), (0.0, 1.0, 0.0), 4.5),  # wall
        (1, (4.4, 0.4, 5.0), (0.0, 0.0, -1.0), math.inf),  # inside the box about it, outside the disc
        (2, (7.0, 0.0, 5.0), (0.0, 0.0, -1.0), 2.0),
        (2, (7.0, 5.0, 0.0), (0.0, -1.0, 0.0), 3.0),
        (3, (9.4, 0.5, 5.0), (0.0, 0.0, -1.0), 5.0),  # lying half
        (3, (5.0, 0.5, 0.5), (1.0, 0.0, 0.0), 4.0),  # standing half
        (3, (9.4, 1.5, 5.0), (0.0, 0.0, -1.0), math.inf),
    ],
)
def test_rays_meet_shapes_where_geometry_says(
    primitive: int, origin: tuple[float, ...], direction: tuple[float, ...], expected: float
) -> None:
    assert hit(four_shapes(), primitive, origin, direction) == pytest.approx(expected, abs=1e-12)


def test_surface_points_are_where_the_pixels_see_them() -> None:
    """Depth, primitive and local point of a traced image, put back into the world, project to their pixels."""
    geometry = four_shapes()
    # looks down from 20 m; x of the image is x of the world, y of the image is -y
    down = np.array([[[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]])
    camera = Pinhole(np.array([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]]), down, np.array([5.0, 0.5, 20.0]))
    depth, primitive = np.zeros((24, 32), np.float32), np.zeros((24, 32), np.int16)
    local = np.zeros((24, 32, 3), np.float32)
    trace_surface(geometry, camera, depth, primitive, local)
    assert set(np.unique(primitive)) == {-1, 0, 1, 2, 3}
    assert (depth[primitive == -1] == 0).all()
    assert depth[primitive == 0] == pytest.approx(19.5)
    y, x = np.nonzero(primitive >= 0)
    points, seen = np.zeros((len(x), 3)), np.zeros(len(x), np.bool_)
    see_points(geometry, camera, primitive[y, x].astype(np.int64), local[y, x].astype(np.float64), points, seen)
    assert seen.all()
    z = 20.0 - points[:, 2]
    np.testing.assert_allclose(z, depth[y, x], atol=1e-5)
    np.testing.assert_allclose(40 * (points[:, 0] - 5) / z + 16, x + 0.5, atol=1e-4)
    np.testing.assert_allclose(40 * (0.5 - points[:, 1]) / z + 12, y + 0.5, atol=1e-4)


@pytest.mark.parametrize(("offset", "share"), [(0.0, 1.0), (0.5, 0.5), (1.0, 0.0)])
def test_a_pixel_is_the_mean_light_of_its_square(offset: float, share: float) -> None:
    """A black and a white box meet at x = 8 + offset px: pixel 8 is white by the share that the white one covers."""
    camera = Pinhole(
        np.array([[10.0, 0, 8], [0, 10.0, 8], [0, 0, 1]]),
        np.array([[[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]]),
        np.array([0.0, 0, 10.0]),
    )
    boxes = four_shapes()._replace(
        shape=np.array([BOX, BOX]),
        half=np.array([[50.0, 50, 1], [50.0, 50, 1]]),
        radius=np.array([80.0, 80]),
        position=np.array([[offset - 50.0, 0, -1], [offset + 50.0, 0, -1]]),  # 10 m away 1 px is 1 m
    )
    look = Appearance(
        side=np.array([0, 1]),
        top=np.array([0, 1]),
        gloss=np.zeros(2),
        texels=np.repeat(np.array([[0.0] * 3, [0.5] * 3], np.float32), 4, axis=0),
        levels=np.array([[[0, 2, 2]], [[4, 2, 2]]]),
        extent=np.ones((2, 2)),
        lamp=np.array([0.0, 0, 1000]),
        lamp_radius=0.1,
        lamp_points=np.array([[0.0, 0, 1000]]),
    )
    rgb = np.zeros((16, 16, 3), np.uint8)
    trace_color(boxes, look, camera, rgb)
    light = -np.log(1 - (rgb / 255.0) ** 2.2)  # undoes the display curve, but for a factor
    assert (rgb[:, :8] == 0).all()
    assert (rgb[:, 9:] > 100).all()
    np.testing.assert_allclose(light[:, 8], share * light[:, 9], rtol=0.03)


def test_the_seed_decides_everything(everything: SyntheticScene, view: SyntheticView) -> None:
    again = make_scene("all", 3, FRAMES, WIDTH, HEIGHT)
    repeated = again.render(again.camera.select([5]), [5])
    assert torch.equal(repeated.rgb[0], view.rgb[5])
    assert torch.equal(repeated.depth[0], view.depth[5])
    assert torch.equal(again.state, everything.state)
    other = make_scene("all", 4, FRAMES, WIDTH, HEIGHT)
    assert (other.render(other.camera.select([5]), [5]).rgb[0] != view.rgb[5]).float().mean() > 0.5


def test_episodes_share_the_desk_but_not_the_motion() -> None:
    first, second = (make_scene("push", 1, 5, WIDTH, HEIGHT, episode=e) for e in (0, 1))
    a, b = first.render(first.camera), second.render(second.camera)
    still = (a.instances[2] == 0) & (b.instances[2] == 0)
    assert torch.equal(a.depth[2][still], b.depth[2][still])
    assert not torch.equal(first.state, second.state)
    assert torch.equal(first.camera.world_from_camera, second.camera.world_from_camera)


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("static", ("background",)),
        ("push", ("background", "robot", "block")),
        ("lid", ("background", "robot", "lid")),
        ("sheet", ("background", "robot", "sheet")),
        ("all", ("background", "robot", "block", "lid", "sheet")),
        ("hand", ("background", "block", "hand")),
        ("spin", ("background", "windmill")),
    ],
)
def test_instances_are_what_moves(kind: str, names: tuple[str, ...]) -> None:
    scene = make_scene(kind, 0, 4, WIDTH, HEIGHT)
    seen = scene.render(scene.camera)
    assert scene.instance_names == names
    assert seen.instances.unique().tolist() == list(range(len(names)))
    # whatever is background before and after is exactly the same surface
    still = (seen.instances[:-1] == 0) & (seen.instances[1:] == 0)
    assert torch.equal(seen.depth[:-1][still], seen.depth[1:][still])
    assert still.float().mean() > 0.6
    if kind != "static":
        assert (seen.depth[0] != seen.depth[2]).any()
    else:
        assert torch.equal(seen.rgb[0], seen.rgb[3])
        assert len(scene.tracks(10)) == 0


def test_depth_and_colour_agree_between_cameras(everything: SyntheticScene, view: SyntheticView) -> None:
    frame = 6
    side = everything.cameras["side"].select([frame])
    other = everything.render(side, [frame])
    front = everything.camera.select([frame])
    camera_points = unproject_image(view.depth[frame], front.intrinsics[0]).reshape(-1, 3)
    world = transform_points(front.world_from_camera[0], camera_points)
    xy, z = project(transform_points(side.camera_from_world[0], world), side.intrinsics[0])
    inside = (z > 0) & (xy >= 0).all(-1) & (xy < torch.tensor([WIDTH, HEIGHT])).all(-1)
    column, row = xy[inside].long().unbind(-1)
    gap = z[inside] - other.depth[0, row, column]
    both = gap.abs() < 0.004
    assert both.float().mean() > 0.45
    # nothing is before the first surface, but for half a pixel of slope and edges
    assert (gap < -0.02).float().mean() < 0.02
    seen, expected = view.rgb[frame].reshape(-1, 3)[inside][both], other.rgb[0, row, column][both]
    # median over textured surfaces sampled up to half a pixel off
    assert (seen.float() - expected.float()).abs().median() < 8
    shuffled = expected[torch.randperm(len(expected), generator=torch.Generator().manual_seed(0))]
    assert (seen.float() - shuffled.float()).abs().median() > 20


def test_tracks_stay_on_their_surface(everything: SyntheticScene, view: SyntheticView) -> None:
    tracks = everything.tracks(120)
    assert len(tracks) == 120
    assert tracks.instance.bincount().tolist() == [0, 30, 30, 30, 30]
    rows = torch.arange(len(tracks))
    assert tracks.visible[rows, tracks.query].all()
    picked = tracks.xy[rows, tracks.query]
    torch.testing.assert_close(picked, picked.floor() + 0.5, atol=2e-3, rtol=0)
    point, time = tracks.visible.nonzero(as_tuple=True)
    column, row = tracks.xy[point, time].long().unbind(-1)
    camera_points = transform_points(everything.camera.camera_from_world, tracks.positions.transpose(0, 1))
    gap = camera_points[time, point, 2] - view.depth[time, row, column]
    same = view.instances[time, row, column] == tracks.instance[point]
    # up to half a pixel from the pixel's centre: edges may show another instance
    assert same.float().mean() > 0.85
    assert gap[same].abs().median() < 0.001
    hidden, time = (~tracks.visible).nonzero(as_tuple=True)
    column, row = tracks.xy[hidden, time].long().unbind(-1)
    inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    column, row = column.clamp(0, WIDTH - 1), row.clamp(0, HEIGHT - 1)
    behind = camera_points[time, hidden, 2] - view.depth[time, row, column]
    assert (behind[inside] > 0.001).float().mean() > 0.85


def test_tracks_of_a_body_move_with_it(everything: SyntheticScene) -> None:
    tracks = everything.tracks(120)
    for name in ("block", "lid", "forearm", "gripper"):
        body = everything.body_names.index(name)
        points = tracks.positions[tracks.body == body]
        assert len(points) >= 3, name
        poses = everything.world_from_body[body]
        local = transform_points(invert_se3(poses), points.transpose(0, 1))
        torch.testing.assert_close(local, local[:1].expand_as(local), atol=2e-6, rtol=0)
        assert (points[:, 0] - points[:, FRAMES // 2]).norm(dim=-1).max() > 0.01
    sheet = tracks.positions[tracks.body == everything.body_names.index("sheet")]
    shape = sheet.double().transpose(0, 1)
    apart = torch.cdist(shape, shape, compute_mode="donot_use_mm_for_euclid_dist")
    assert (apart - apart[:1]).abs().max() > 0.02  # it bends
    assert (apart <= apart[0] + 1e-5).all()  # and never stretches: it lies flat in the first frame


@pytest.mark.parametrize("episode", range(8))
def test_the_hand_takes_the_block(episode: int) -> None:
    """Its fingers close on it, touch its sides without going into them, and stay with it as long as it moves."""
    scene = make_scene("hand", 0, 60, WIDTH, HEIGHT, episode=episode)
    poses = dict(zip(scene.body_names, scene.world_from_body.double(), strict=True))
    block = poses["block"]
    moving = ((block[1:] - block[:-1]).abs().amax((1, 2)) > 1e-6).nonzero()[:, 0]
    held = slice(int(moving[0]), int(moving[-1]) + 2)
    assert block[held, 2, 3].max() > 0.06
    assert (block[-1, :2, 3] - block[0, :2, 3]).norm() > 0.12
    sphere = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)).double()
    sphere /= sphere.norm(dim=-1, keepdim=True)
    for finger in ("thumb", "index", "middle", "ring"):
        block_from_finger = invert_se3(block) @ poses[finger]
        still = block_from_finger[held]
        torch.testing.assert_close(still, still[:1].expand_as(still), atol=1e-6, rtol=0)
        limbs = [p for p in scene.primitives if p.body == finger]
        skin = [transform_points(torch.from_numpy(p.body_from_primitive), sphere * torch.tensor(p.half)) for p in limbs]
        own = transform_points(block_from_finger, torch.cat(skin).expand(60, -1, 3))
        gap = (
            (own.abs() - torch.tensor(BLOCK_HALF)).amax(-1).amin(1)
        )  # m, of the nearest point, per frame; less than 0: inside
        assert gap.min() > -1e-4
        assert gap[held].max() < 0.001
        assert min(gap[0], gap[-1]) > 0.01


@pytest.mark.parametrize("episode", range(4))
def test_the_windmill_turns_about_its_hub(episode: int) -> None:
    scene = make_scene("spin", 0, 48, WIDTH, HEIGHT, episode=episode)
    rotor = scene.world_from_body[scene.body_names.index("rotor")].double()
    assert (rotor[:, :3, 3] == rotor[0, :3, 3]).all()
    axes = rotor[:, :3, 1]
    torch.testing.assert_close(axes, axes[:1].expand_as(axes), atol=1e-6, rtol=0)
    steps = (rotor[:-1, :3, 0] * rotor[1:, :3, 0]).sum(-1).clamp(-1, 1).acos()
    assert steps.sum() >= 2 * math.pi  # once round at least
    assert steps.max() < math.radians(22)  # so that a vane is not taken for the next
    assert axes[0, 1] > 0.8  # it faces the camera


@pytest.mark.parametrize("kind", ["push", "lid", "sheet"])
@pytest.mark.parametrize("episode", range(8))
def test_the_gripper_carries_what_it_moves(kind: str, episode: int) -> None:
    scene = make_scene(kind, 0, 40, WIDTH, HEIGHT, episode=episode)
    moved = {"push": "block", "lid": "lid", "sheet": "dowel"}[kind]
    poses = scene.world_from_body[scene.body_names.index(moved)]
    grip = scene.world_from_body[scene.body_names.index("gripper")][:, :3, 3]
    # the place at which the fingers hold it, in its own frame, when the motion is half done
    way = (poses - poses[:1]).abs().amax((1, 2))
    moving = (way[1:] - way[:-1]).abs() > 1e-4
    start, stop = int(moving.nonzero()[0]), int(moving.nonzero()[-1])
    held = transform_points(invert_se3(poses), grip[:, None])[start + 1 : stop, 0]
    assert len(held) > 5
    # push: rigid; lid and dowel turn between fingers that stay upright, a few mm about the point they hold
    assert (held - held.mean(0)).norm(dim=-1).max() < (1e-5 if kind == "push" else 0.012)
    # at 30 fps no faster than arms are
    assert (scene.state[1:, :3] - scene.state[:-1, :3]).norm(dim=-1).max() < 0.025
    assert torch.equal(scene.action[:-1], scene.state[1:])


def test_heldout_cameras_are_where_they_say() -> None:
    cameras = heldout_cameras(2, WIDTH, HEIGHT)
    front = make_scene("static", 0, 2, WIDTH, HEIGHT).camera.world_from_camera[0]
    target = front[:3, 3] + 0.7 * front[:3, 2]  # 0.7 m in front of the lens

    def bearing(pose: torch.Tensor) -> tuple[float, float, float]:
        x, y, z = (pose[:3, 3] - target).tolist()
        azimuth, elevation = math.atan2(x, -y), math.atan2(z, math.hypot(x, y))
        return math.degrees(azimuth), math.degrees(elevation), math.hypot(x, y, z)

    for name, azimuth, rise, distance in (
        ("az-10", -10, 0, 0.7),
        ("az+05", 5, 0, 0.7),
        ("el+08", 0, 8, 0.7),
        ("el-08", 0, -8, 0.7),
        ("dolly", 0, 0, 0.616),
    ):
        pose = cameras[name].world_from_camera[1]
        assert bearing(pose) == pytest.approx((azimuth, bearing(front)[1] + rise, distance), abs=1e-3)
        torch.testing.assert_close(pose[:3, 3] + distance * pose[:3, 2], target, atol=1e-5, rtol=0)
    step = cameras["tx+05"].world_from_camera[0] - front
    torch.testing.assert_close(step[:3, 3], torch.tensor([0.05, 0, 0]), atol=1e-6, rtol=0)
    assert not step[:3, :3].any()


def test_covisibility(everything: SyntheticScene, view: SyntheticView) -> None:
    frames = [2, 7]
    covered = covisibility(everything, view.depth.numpy(), everything.camera.select(frames), frames)
    assert (covered[:, 1:-1, 1:-1] == 2).all()
    camera = heldout_cameras(2, WIDTH, HEIGHT)["az+10"]
    values = covisibility(everything, view.depth.numpy(), camera, frames)
    share = np.bincount(values.ravel(), minlength=3) / values.size
    assert share[2] > 0.75
    assert 0.001 < share[1] < 0.15  # hidden now, seen at another time
    assert share[0] > 0.02
    still = make_scene("static", 3, 2, WIDTH, HEIGHT)
    depth = still.render(still.camera).depth.numpy()
    assert set(np.unique(covisibility(still, depth, camera, [0, 1]))) == {0, 2}


def test_wrong_requests_are_refused(everything: SyntheticScene) -> None:
    with pytest.raises(ConfigError, match="'pour' is unknown; expected one of push, lid"):
        make_scene("pour", 0, 2, WIDTH, HEIGHT)
    with pytest.raises(ConfigError, match="at least 1 frame, got 0"):
        make_scene("push", 0, 0, WIDTH, HEIGHT)
    with pytest.raises(ConfigError, match="3 poses for 12 frames"):
        everything.render(everything.camera.select([0, 1, 2]))


@pytest.mark.slow
def test_a_dataset_reads_back(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    scenes = [make_scene("push", 0, frames, WIDTH, HEIGHT, episode=e) for e, frames in enumerate((5, 7))]
    root = tmp_path / "ds"
    write_dataset(scenes, "test/push", root, cameras=("front", "wrist"), depth=True)
    read = LeRobotDataset("test/push", root=root, video_backend="pyav", depth_output_unit="m")
    assert (read.num_episodes, read.num_frames, read.fps) == (2, 12, 30)
    assert sorted(read.meta.depth_keys) == ["observation.images.front_depth", "observation.images.wrist_depth"]
    assert read.meta.features["observation.images.front_depth"]["info"]["depth_unit"] == "mm"
    views = [scene.render(scene.cameras["wrist"]) for scene in scenes]
    for index, (e, t) in ((0, (0, 0)), (4, (0, 4)), (5, (1, 0)), (11, (1, 6))):
        item = read[index]
        torch.testing.assert_close(item["observation.state"], scenes[e].state[t], atol=0, rtol=0)
        torch.testing.assert_close(item["action"], scenes[e].action[t], atol=0, rtol=0)
        assert item["task"] == "push the block"
        # half a millimetre of rounding and half of LeRobot's 12-bit logarithmic step (1.5 mm at 1 m)
        torch.testing.assert_close(item["observation.images.wrist_depth"][0], views[e].depth[t], atol=0.0014, rtol=0)
        error = item["observation.images.wrist"].permute(1, 2, 0) - views[e].rgb[t] / 255
        assert -10 * error.square().mean().log10() > 25
    with pytest.raises(OutputError, match="exists already"):
        write_dataset(scenes, "test/push", root)


def test_a_dataset_of_images_is_lossless(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    scene = make_scene("push", 0, 2, 32, 24)
    write_dataset([scene], "test/images", tmp_path / "ds", depth=True, image_dtype="image")
    item = LeRobotDataset("test/images", root=tmp_path / "ds", video_backend="pyav", depth_output_unit="m")[1]
    view = scene.render(scene.camera)
    assert torch.equal((item["observation.images.front"] * 255).round().byte().permute(1, 2, 0), view.rgb[1])
    torch.testing.assert_close(item["observation.images.front_depth"][0], view.depth[1], atol=5.1e-4, rtol=0)


def test_a_dataset_needs_scenes_and_cameras_that_fit(tmp_path: Path) -> None:
    scene, wide = make_scene("push", 0, 2, 32, 24), make_scene("push", 0, 2, 64, 24)
    with pytest.raises(ConfigError, match="at least one scene"):
        write_dataset([], "test/ds", tmp_path / "ds")
    with pytest.raises(ConfigError, match=r"no camera \['top'\]; expected some of \['front', 'side', 'wrist'\]"):
        write_dataset([scene], "test/ds", tmp_path / "ds", cameras=("front", "top"))
    with pytest.raises(ConfigError, match=r"one \(fps, width, height\)"):
        write_dataset([scene, wide], "test/ds", tmp_path / "ds")
    with pytest.raises(ConfigError, match="image_dtype 'gif' is unknown"):
        write_dataset([scene], "test/ds", tmp_path / "ds", image_dtype="gif")
    assert not (tmp_path / "ds").exists()


@pytest.mark.slow
def test_the_nvs_folder_is_complete(tmp_path: Path) -> None:
    scene = make_scene("sheet", 0, 6, WIDTH, HEIGHT)
    root = tmp_path / "sheet"
    write_nvs_folder(scene, root, every=3)
    for name in ("dataset", "dataset_depth"):
        assert json.loads((root / name / "meta" / "info.json").read_text())["total_frames"] == 6
    meta = json.loads((root / "gt" / "meta.json").read_text())
    assert meta["heldout"] == sorted(meta["heldout"], key=list(heldout_cameras(1, 4, 4)).index)
    assert "sheet" in meta["dynamic_names"]
    assert "block" not in meta["dynamic_names"]
    view = scene.render(scene.camera)
    train, motion = np.load(root / "gt" / "train.npz"), np.load(root / "gt" / "bodies.npz")
    np.testing.assert_allclose(np.moveaxis(train["depth"], -1, 0) * 1e-4, view.depth.numpy(), atol=5.1e-5)
    assert (np.isin(train["seg"], meta["dynamic_ids"]) == np.moveaxis(view.instances.numpy() > 0, 0, -1)).all()
    assert motion["pose"].shape == (6, len(meta["bodies"]), 7)
    assert motion["flex_faces"].max() + 1 == motion["flex_verts"].shape[1]
    tracks = np.load(root / "gt" / "tracks.npz")
    assert tracks["uv"].shape == (6, 200, 2)
    assert set(tracks["body"]) <= set(meta["dynamic_ids"])
    for name in meta["heldout"]:
        held = np.load(root / "gt" / "heldout" / f"{name}.npz")
        assert held["frame"].tolist() == [0, 3]
        assert held["covis"].shape == held["seg"].shape == (HEIGHT, WIDTH, 2)
        with av.open(str(root / "gt" / "heldout" / f"{name}.mkv")) as container:
            video = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        stills = [read_picture(root / "gt" / "heldout" / name / f"rgb_{f:04d}.png") for f in (0, 3)]
        np.testing.assert_array_equal(np.stack(video), np.stack(stills))
    expected = scene.render(heldout_cameras(1, WIDTH, HEIGHT)["dolly"], [3]).rgb[0].numpy()
    np.testing.assert_array_equal(read_picture(root / "gt/heldout/dolly/rgb_0003.png"), expected)
    with pytest.raises(OutputError, match="exists already"):
        write_nvs_folder(scene, root)
    with pytest.raises(ConfigError, match="every must be at least 1"):
        write_nvs_folder(scene, tmp_path / "other", every=0)


def test_command_line(tmp_path: Path) -> None:
    arguments = ["--out", str(tmp_path / "ds"), "--episodes", "2", "--frames", "3", "--width", "64", "--height", "64"]
    assert run(arguments) == 0
    info = json.loads((tmp_path / "ds" / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"]) == (2, 6)
    with pytest.raises(OutputError, match="exists already"):
        run(arguments)
