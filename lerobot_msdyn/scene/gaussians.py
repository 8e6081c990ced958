"""Gaussians, and a scene of a static and a moving set; saved as safetensors with a schema version."""

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from lerobot_msdyn.core.errors import MsdynError
from lerobot_msdyn.core.files import write_whole
from lerobot_msdyn.core.geometry import quaternion_multiply, quaternion_to_matrix
from lerobot_msdyn.motion.field import DeformationField
from lerobot_msdyn.motion.model.bases import MotionLevel
from lerobot_msdyn.motion.model.compose import Level, compose
from lerobot_msdyn.scene.overlay import FramePatch, Overlay
from lerobot_msdyn.scene.shading import Shading

SCHEMA_VERSION = 3
LEVEL_KINDS: dict[str, type] = {"bases": MotionLevel, "field": DeformationField}
PATCH_OPACITY = 0.95  # of an overlay's Gaussians
SH_C0 = 0.28209479177387814  # the constant spherical harmonic
SH_C1 = 0.4886025119029199  # of the three linear ones
_SMALLEST_M = 1e-9  # standard deviation: far below any surface's, also where depth is of a wrong scale


@dataclass(frozen=True)
class Gaussians:
    """A set of anisotropic Gaussians; colours as spherical harmonics (3DGS, Kerbl et al. 2023)."""

    means: Float[Tensor, "g 3"]  # m
    quats: Float[Tensor, "g 4"]  # wxyz, of any non-zero length
    log_scales: Float[Tensor, "g s"]  # log of standard deviations in m; s = 3, or 1 for isotropic Gaussians
    opacity_logits: Float[Tensor, " g"]
    sh: Float[Tensor, "g k 3"]

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def rgb(self) -> Float[Tensor, "g 3"]:
        """Colours 0..1 (degree 0)."""
        return (self.sh[:, 0] * SH_C0 + 0.5).clamp(min=0)

    @property
    def scales(self) -> Float[Tensor, "g 3"]:
        """Standard deviations along the three axes, m."""
        return self.log_scales.exp().expand(-1, 3)

    def select(self, which: Tensor | slice) -> "Gaussians":
        """Some of the Gaussians, by index, mask or slice."""
        return Gaussians(**{item.name: getattr(self, item.name)[which] for item in fields(self)})


def with_slope(gaussians: Gaussians) -> Gaussians:
    """The same set with spherical harmonics of degree 1, whose linear part is zero."""
    return replace(gaussians, sh=torch.nn.functional.pad(gaussians.sh[:, :1], (0, 0, 0, 3)))


def shaded(sh: Float[Tensor, "m 4 3"], direction: Float[Tensor, "b m 3"]) -> Float[Tensor, "b m 3"]:
    """Colours 0..1 of spherical harmonics of degree 1 seen along directions of length 1 (in the canonical frame)."""
    x, y, z = direction[..., None].unbind(-2)
    linear = -y * sh[:, 1] + z * sh[:, 2] - x * sh[:, 3]
    return (SH_C0 * sh[:, 0] + SH_C1 * linear + 0.5).clamp(min=0)


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """One set of several."""
    return Gaussians(**{item.name: torch.cat([getattr(p, item.name) for p in parts]) for item in fields(Gaussians)})


def gaussians_from_points(
    means: Float[Tensor, "g 3"],
    quats: Float[Tensor, "g 4"],
    scales: Float[Tensor, "g 3"],
    rgb: Float[Tensor, "g 3"],
    opacity: float,
) -> Gaussians:
    """Gaussians of given linear scales (m), colours 0..1 and one common opacity."""
    logit = torch.logit(torch.tensor(opacity))
    return Gaussians(
        means=means.contiguous(),
        quats=quats.contiguous(),
        log_scales=scales.clamp(min=_SMALLEST_M).log(),
        opacity_logits=logit.expand(len(means)).clone(),
        sh=rgb_to_sh(rgb),
    )


def rgb_to_sh(rgb: Float[Tensor, "g 3"]) -> Float[Tensor, "g 1 3"]:
    """Colours 0..1 as spherical harmonics of degree 0."""
    return ((rgb - 0.5) / SH_C0)[:, None].contiguous()


@dataclass(frozen=True)
class Snapshot:
    """All Gaussians of a scene at some frames, ready to be rasterized: the static ones first."""

    means: Float[Tensor, "b g 3"]
    quats: Float[Tensor, "b g 4"]
    scales: Float[Tensor, "g 3"]
    opacities: Float[Tensor, " g"]
    rgb: Float[Tensor, "b g 3"]
    moving: Float[Tensor, " g"]  # 1 for the moving set, 0 for the static one
    extra: Float[Tensor, " g"] | None = None  # another value of each


def patched(snapshot: Snapshot, patch: FramePatch) -> Snapshot:
    """A snapshot of one frame, with a patch in place of what the patch hides; the patch counts as moving."""
    kept, ones = (~patch.hidden).nonzero()[:, 0], patch.means.new_ones(len(patch))
    return Snapshot(
        means=torch.cat((snapshot.means[:, kept], patch.means[None]), dim=1),
        quats=torch.cat((snapshot.quats[:, kept], patch.quats[None]), dim=1),
        scales=torch.cat((snapshot.scales[kept], patch.log_scales.exp())),
        opacities=torch.cat((snapshot.opacities[kept], PATCH_OPACITY * ones)),
        rgb=torch.cat((snapshot.rgb[:, kept], patch.rgb[None]), dim=1),
        moving=torch.cat((snapshot.moving[kept], ones)),
        extra=None if snapshot.extra is None else torch.cat((snapshot.extra[kept], ones)),
    )


@dataclass(frozen=True)
class DynamicScene:
    """A static set, a moving set in its canonical frame, and the levels of motion that carry it (docs/method.md)."""

    static: Gaussians
    moving: Gaussians
    levels: tuple[Level, ...]  # coarse to fine
    indices: tuple[Int[Tensor, "n _"], ...]  # per level: the bases that move each Gaussian
    logits: tuple[Float[Tensor, "n _"], ...]  # per level: their weights before the softmax
    frames: int
    shading: Shading | None = None  # none: brightness does not change
    near: float = 0.01  # m; nothing that is as near to a camera is drawn
    overlay: Overlay | None = None  # none: nothing is shown as it was recorded

    @property
    def device(self) -> torch.device:
        """Where its tensors are."""
        return self.static.means.device

    def select_moving(self, which: Tensor | slice) -> "DynamicScene":
        """The same with some Gaussians of the moving set, by index, mask or slice; of a scene without an overlay."""
        shading = None if self.shading is None else replace(self.shading, moving=self.shading.moving[:, which])
        indices, logits = (tuple(rows[which] for rows in levels) for levels in (self.indices, self.logits))
        return replace(self, moving=self.moving.select(which), indices=indices, logits=logits, shading=shading)

    def still(self) -> "DynamicScene":
        """The same without what moves and without an overlay: the static set, its brightness and the near plane."""
        return replace(self.select_moving(slice(0)), levels=(), indices=(), logits=(), overlay=None)

    def at(self, frames: Int[Tensor, " b"], eye: Float[Tensor, "b 3"] | None = None) -> Snapshot:
        """The scene at some frames, differentiable in all Gaussians and bases.

        Args:
            frames: the frames.
            eye: from where it is seen at each (m), for colours that depend on it; without, their means are given.
        """
        static, moving, frames = self.static, self.moving, frames.to(self.device)
        means, quats = compose(moving.means, moving.quats, self.levels, self.indices, self.logits, frames)
        b = len(frames)
        return Snapshot(
            means=torch.cat((static.means.expand(b, -1, -1), means), dim=1),
            quats=torch.cat((static.quats.expand(b, -1, -1), quats), dim=1),
            scales=torch.cat((static.scales, moving.scales)),
            opacities=torch.cat((static.opacity_logits, moving.opacity_logits)).sigmoid(),
            rgb=self._colours(frames, means, quats, eye),
            moving=torch.cat((torch.zeros_like(static.opacity_logits), torch.ones_like(moving.opacity_logits))),
        )

    def tensors(self) -> dict[str, Tensor]:
        """All that the scene is made of, by the names of its file."""
        tensors: dict[str, Tensor] = {}
        if self.shading is not None:
            tensors |= {f"shading.{item.name}": getattr(self.shading, item.name) for item in fields(Shading)}
        if self.overlay is not None:
            tensors |= {f"overlay.{item.name}": getattr(self.overlay, item.name) for item in fields(Overlay)}
        for name, part in (("static", self.static), ("moving", self.moving)):
            tensors |= {f"{name}.{item.name}": getattr(part, item.name) for item in fields(part)}
        for i, level in enumerate(self.levels):
            tensors |= {f"levels.{i}.{item.name}": getattr(level, item.name) for item in fields(level)}
            tensors |= {f"levels.{i}.indices": self.indices[i], f"levels.{i}.logits": self.logits[i]}
        return tensors

    def _colours(
        self,
        frames: Int[Tensor, " b"],
        means: Float[Tensor, "b m 3"],
        quats: Float[Tensor, "b m 4"],
        eye: Float[Tensor, "b 3"] | None,
    ) -> Float[Tensor, "b g 3"]:
        """Colours at some frames, given where the moving set is there and how it is turned."""
        static = self.static.rgb.expand(len(frames), -1, -1)
        moving = self.moving.rgb.expand(len(frames), -1, -1)
        if eye is not None and self.moving.sh.shape[1] > 1:
            back = quaternion_multiply(self.moving.quats, quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0]))
            sight = torch.nn.functional.normalize(means - eye[:, None], dim=-1)
            moving = shaded(self.moving.sh, (quaternion_to_matrix(back) @ sight[..., None])[..., 0])
        if self.shading is not None:
            static = static * self.shading.static_gain(frames)[..., None]
            moving = moving * self.shading.moving_gain(frames)[..., None]
        return torch.cat((static, moving), dim=1)


def isotropic(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians as balls of the same cross-section: the geometric mean of the two larger axes."""
    two_larger = gaussians.log_scales.sort(dim=-1, descending=True).values[:, :2]
    return replace(gaussians, log_scales=two_larger.mean(-1, keepdim=True))


def save_scene(scene: DynamicScene, path: Path) -> None:
    """Write a scene as one safetensors file, atomically."""
    names = {kind: name for name, kind in LEVEL_KINDS.items()}
    header = {
        "schema": SCHEMA_VERSION,
        "levels": [names[type(level)] for level in scene.levels],
        "frames": scene.frames,
        "near": scene.near,
    }
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in scene.tensors().items()}
    write_whole(path, save(tensors, metadata={"lerobot_msdyn": json.dumps(header)}))


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
    if header.get("schema") != SCHEMA_VERSION:
        raise MsdynError(f"{path}: scene schema is {header.get('schema')}; expected {SCHEMA_VERSION}; fit it again")
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
