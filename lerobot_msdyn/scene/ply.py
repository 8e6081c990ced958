"""Gaussians as .ply files in the layout of 3D Gaussian Splatting (Kerbl et al. 2023), which common viewers open."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.geometry import quaternion_conjugate, quaternion_multiply, quaternion_to_matrix
from lerobot_msdyn.motion.model.compose import compose
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.scene.gaussians import SH_C0, Gaussians, concatenate, gaussians_from_points, rgb_to_sh
from lerobot_msdyn.scene.overlay import PATCH_OPACITY
from lerobot_msdyn.scene.store import SavedScene

_HEADER_BYTES = 64 * 1024  # no header is longer


def gaussians_at(scene: DynamicScene, frame: int) -> Gaussians:
    """All Gaussians of a scene as they are at one frame: moved, turned, as bright as then, overlaid by that frame's."""
    time = torch.tensor([frame])
    static, moving = scene.static, scene.moving
    means, quats = compose(moving.means, moving.quats, scene.levels, scene.indices, scene.logits, time)
    turn = quaternion_to_matrix(quaternion_multiply(quats[0], quaternion_conjugate(moving.quats)))
    sh = [static.sh, _turned(moving.sh, turn)]
    if scene.shading is not None:
        gains = (scene.shading.static_gain(time)[0], scene.shading.moving_gain(time)[0])
        sh = [_brightened(colours, gain) for colours, gain in zip(sh, gains, strict=True)]
    degree = max(colours.shape[1] for colours in sh)
    sh = [torch.nn.functional.pad(colours, (0, 0, 0, degree - colours.shape[1])) for colours in sh]
    log_scales = [part.log_scales.expand(-1, 3) for part in (static, moving)]
    whole = concatenate(
        [
            Gaussians(static.means, static.quats, log_scales[0], static.opacity_logits, sh[0]),
            Gaussians(means[0], quats[0], log_scales[1], moving.opacity_logits, sh[1]),
        ]
    )
    patch = scene.patch(frame)
    if patch is None:
        return whole
    shown = gaussians_from_points(patch.means, patch.quats, patch.log_scales.exp(), patch.rgb, PATCH_OPACITY)
    flat = torch.nn.functional.pad(shown.sh, (0, 0, 0, degree - 1))
    return concatenate([whole.select(~patch.hidden), replace(shown, sh=flat)])


def _turned(sh: Float[Tensor, "m k 3"], turn: Float[Tensor, "m 3 3"]) -> Float[Tensor, "m k 3"]:
    """Spherical harmonics of degree 0 or 1 of Gaussians that were turned."""
    if sh.shape[1] == 1:
        return sh
    slope = turn @ torch.stack((-sh[:, 3], -sh[:, 1], sh[:, 2]), dim=1)  # by x, y, z
    return torch.stack((sh[:, 0], -slope[:, 1], slope[:, 2], -slope[:, 0]), dim=1)


def _brightened(sh: Float[Tensor, "m k 3"], gain: Float[Tensor, " m"]) -> Float[Tensor, "m k 3"]:
    """Spherical harmonics of colours that are multiplied by a gain."""
    base = rgb_to_sh((sh[:, 0] * SH_C0 + 0.5) * gain[:, None])
    return torch.cat((base, sh[:, 1:] * gain[:, None, None]), dim=1)


def export_frames(scene: SavedScene, frames: Sequence[int], folder: Path) -> list[Path]:
    """Write some frames of a saved scene to FOLDER/frame_000000.ply and so on; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    windows = scene.windows_of(torch.tensor(frames)).tolist()
    paths = []
    for frame, window in zip(frames, windows, strict=True):
        path = folder / f"frame_{frame:06d}.ply"
        save_ply(gaussians_at(scene.windows[window], frame - scene.starts[window]), path)
        paths.append(path)
    return paths


def save_ply(gaussians: Gaussians, path: Path) -> None:
    """Write Gaussians as a binary .ply; positions in m, scales as logarithms, opacities as logits, wxyz."""
    count = len(gaussians)
    rest = gaussians.sh[:, 1:].transpose(1, 2).reshape(count, -1)  # all of red, all of green, all of blue
    columns = {
        "x y z": gaussians.means,
        "nx ny nz": torch.zeros(count, 3),
        " ".join(f"f_dc_{i}" for i in range(3)): gaussians.sh[:, 0],
        " ".join(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        "opacity": gaussians.opacity_logits[:, None],
        "scale_0 scale_1 scale_2": gaussians.log_scales.expand(-1, 3),
        "rot_0 rot_1 rot_2 rot_3": gaussians.quats / gaussians.quats.norm(dim=-1, keepdim=True),
    }
    names = [name for group in columns for name in group.split()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    values = torch.cat(list(columns.values()), dim=1).detach().cpu().numpy().astype("<f4")
    path.write_bytes("\n".join(header).encode() + values.tobytes())


def load_ply(path: Path) -> Gaussians:
    """Read Gaussians from a binary .ply in the layout of 3D Gaussian Splatting, of any degree.

    Raises:
        MsdynError: the file is absent, damaged, or of another layout.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise MsdynError(f"{path} cannot be read ({error})") from error
    head, end, _ = content[:_HEADER_BYTES].partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").split("\n")
    if not end or lines[0].strip() != "ply" or "format binary_little_endian 1.0" not in lines:
        raise MsdynError(f"{path}: expected a .ply file of format binary_little_endian 1.0")
    elements = [line.split() for line in lines if line.startswith("element ")]
    properties = [line.split() for line in lines if line.startswith("property ")]
    if [element[1] for element in elements] != ["vertex"] or any(kind[1] != "float" for kind in properties):
        raise MsdynError(f"{path}: expected vertices of float properties alone, as 3D Gaussian Splatting writes them")
    names, count = [item[-1] for item in properties], int(elements[0][2])
    values = np.frombuffer(content, "<f4", offset=len(head) + len(end))
    if values.size != count * len(names):
        raise MsdynError(f"{path}: {values.size} numbers; expected {count} vertices of {len(names)}; truncated?")
    table = dict(zip(names, torch.from_numpy(values.reshape(count, -1).copy()).unbind(-1), strict=True))
    rest = sum(name.startswith("f_rest_") for name in names)

    def columns(*wanted: str) -> Tensor:
        try:
            return torch.stack([table[name] for name in wanted], dim=-1)
        except KeyError as error:
            raise MsdynError(f"{path}: property {error} is missing; not a file of 3D Gaussian Splatting") from error

    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        sh = torch.cat(
            (sh, columns(*(f"f_rest_{i}" for i in range(rest))).reshape(count, 3, -1).transpose(1, 2)), dim=1
        )
    return Gaussians(
        means=columns("x", "y", "z"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        log_scales=columns("scale_0", "scale_1", "scale_2"),
        opacity_logits=columns("opacity")[:, 0],
        sh=sh.contiguous(),
    )
