"""The .ply layout of 3D Gaussian Splatting, out and back."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, matrix_to_quaternion
from lerobot_msdyn.scene import store as saved
from lerobot_msdyn.scene.dynamic import patched
from lerobot_msdyn.scene.gaussians import Gaussians, gaussians_from_points, shaded, with_slope
from lerobot_msdyn.scene.ply import export_frames, gaussians_at, load_ply, save_ply


def some_gaussians(count: int = 5) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    flat = gaussians_from_points(
        torch.randn(count, 3, generator=generator),
        torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        torch.rand(count, 3, generator=generator) + 0.1,
        torch.rand(count, 3, generator=generator),
        0.7,
    )
    return replace(flat, sh=torch.randn(count, 4, 3, generator=generator))


@pytest.mark.parametrize("degree", [0, 1])
def test_what_is_written_comes_back(tmp_path: Path, degree: int) -> None:
    gaussians = some_gaussians()
    gaussians = gaussians if degree else replace(gaussians, sh=gaussians.sh[:, :1])
    save_ply(gaussians, tmp_path / "a.ply")
    again = load_ply(tmp_path / "a.ply")
    for item in fields(Gaussians):
        torch.testing.assert_close(getattr(again, item.name), getattr(gaussians, item.name))


def test_the_layout_is_that_of_other_programs(tmp_path: Path) -> None:
    save_ply(some_gaussians(2), tmp_path / "a.ply")
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    rest = [f"f_rest_{i}" for i in range(9)]
    dc = ["f_dc_0", "f_dc_1", "f_dc_2"]
    scale, rot = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    assert names == ["x", "y", "z", "nx", "ny", "nz", *dc, *rest, "opacity", *scale, *rot]
    values = torch.frombuffer(bytearray(body), dtype=torch.float32).reshape(2, -1)
    assert torch.equal(values[:, 9:12], some_gaussians(2).sh[:, 1:, 0]), "all of red first"


def test_a_turned_gaussian_looks_as_the_renderer_shows_it() -> None:
    from lerobot_msdyn.scene.ply import _turned

    sh = some_gaussians(4).sh
    turn = axis_angle_to_matrix(torch.randn(4, 3, generator=torch.Generator().manual_seed(1)))
    sight = torch.nn.functional.normalize(torch.randn(1, 4, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    in_its_frame = (turn.transpose(1, 2) @ sight[0, :, :, None])[None, :, :, 0]
    torch.testing.assert_close(shaded(_turned(sh, turn), sight), shaded(sh, in_its_frame))
    assert matrix_to_quaternion(turn).shape == (4, 4)


def test_frames_of_a_scene(desk_scenes: Path, tmp_path: Path) -> None:
    scene = saved.load(saved.list_scenes(desk_scenes)[0]["observation.images.front"])
    overlaid, frame = scene.windows[1], torch.tensor([1])
    scene = replace(scene, windows=tuple(window.without_patches() for window in scene.windows))
    paths = export_frames(scene, range(5, 8), tmp_path)
    assert [path.name for path in paths] == ["frame_000005.ply", "frame_000006.ply", "frame_000007.ply"]
    window, eye = scene.windows[1], torch.zeros(1, 3)
    expected = window.at(frame, eye)
    found = load_ply(paths[2])
    torch.testing.assert_close(found.means, expected.means[0])
    torch.testing.assert_close(found.scales, expected.scales)
    torch.testing.assert_close(found.opacity_logits.sigmoid(), expected.opacities)
    sight = torch.nn.functional.normalize(found.means[None] - eye[:, None], dim=-1)
    still = len(window.static)
    torch.testing.assert_close(shaded(found.sh, sight)[0, still:], expected.rgb[0, still:], atol=1e-3, rtol=0)
    torch.testing.assert_close(found.rgb[:still], expected.rgb[0, :still], atol=1e-5, rtol=0)
    patch = overlaid.patch(1)
    if patch is not None:
        shown, expected = gaussians_at(overlaid, 1), patched(overlaid.at(frame), patch)
        torch.testing.assert_close(shown.means, expected.means[0, expected.opacities > 0])
        torch.testing.assert_close(shown.rgb[-len(patch) :], patch.rgb)
    degree_0 = replace(window, moving=replace(window.moving, sh=window.moving.sh[:, :1]), shading=None)
    assert gaussians_at(degree_0, 0).sh.shape[1] == 1
    assert with_slope(found).sh.shape[1] == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: b"no" + content, "expected a .ply file of format binary_little_endian"),
        (lambda content: content[:-8], "truncated"),
        (lambda content: content.replace(b"property float rot_3", b"property float other"), "'rot_3' is missing"),
        (lambda content: content.replace(b"property float x", b"property uchar x"), "float properties alone"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, change: Callable[[bytes], bytes], message: str) -> None:
    path = tmp_path / "a.ply"
    save_ply(some_gaussians(), path)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(MsdynError, match=message):
        load_ply(path)
    with pytest.raises(MsdynError, match="cannot be read"):
        load_ply(tmp_path / "absent.ply")
