"""What a depth network in a file of ONNX takes and gives: by a YAML file beside it, by settings, or by its name."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.fields import between
from lerobot_msdyn.priors.onnx_file import IMAGENET, SPEC_SUFFIX, PictureSpec, check_names, decoded, read_yaml

# Part of a file's name, without punctuation -> what such networks take and give. The longest that fits counts.
FAMILIES: dict[str, dict[str, Any]] = {
    "depthanythingv2": {"kind": "affine_disparity", **IMAGENET},
    "depthanythingv2metric": {"kind": "metric", **IMAGENET},
    "depthanythingv3": {"kind": "scale", **IMAGENET},
    "midas": {"kind": "affine_disparity", **IMAGENET},
    "dpt": {"kind": "affine_disparity", "mean": [0.5] * 3, "std": [0.5] * 3},
    "metric3d": {"kind": "metric", "white": 255.0, "fit": "pad", "focal_px": 1000.0, "output": "pred_depth"},
    "tcmonodepth": {"kind": "affine_disparity", "white": 255.0},
    "fastdepth": {"kind": "metric"},
}

Kind = Literal["", "metric", "scale", "affine_disparity"]
Fit = Literal["stretch", "pad"]


@dataclass
class OnnxSpec(PictureSpec):
    """What a network takes and gives."""

    # metric (m), scale (depth that lacks a factor), affine_disparity (inverse depth that lacks factor and shift).
    kind: Kind = ""
    # [height, width] of its input in pixels, where the file leaves that open.
    size: list[int] = field(default_factory=list)
    # stretch the picture to the input's size, or pad it with grey.
    fit: Fit = "stretch"
    # Of a metric one: the focal length (px of its input) of the camera whose metres these are; 0: any camera's.
    focal_px: float = between(0.0, 0, 1e6)
    # Name of its output that is depth, where it has several.
    output: str = ""

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        lines = super().problems()
        if self.size and (len(self.size) != 2 or min(self.size) < 1):
            lines.append(f"size is {self.size}; expected [height, width] in px")
        if self.focal_px and self.kind not in ("", "metric"):
            lines.append(f"focal_px is {self.focal_px:g}, but kind is {self.kind}; expected it of metric depth alone")
        return lines


def read_spec(file: Path, settings: dict[str, Any]) -> tuple[OnnxSpec, str]:
    """What is known of a network, and from where: settings go before the YAML beside it, this before its name.

    Raises:
        PriorError: neither says of which kind its depth is, or something said is unknown or of the wrong type.
    """
    beside = file.with_suffix(SPEC_SUFFIX)
    family, known = family_of(file)
    stated = read_yaml(beside)
    origins = [f"as {family} networks", f"by {beside.name}", "by priors.onnx"]
    parts = [known, stated, settings]
    where = [origin for origin, part in zip(origins, parts, strict=True) if part]
    check_names(beside, stated, OnnxSpec)
    check_names(Path("priors.onnx"), settings, OnnxSpec)
    spec = decoded(OnnxSpec, known | stated | settings, f"{file} {' and '.join(where)}")
    if not spec.kind:
        raise PriorError(
            f"{file}: what its numbers mean cannot be told from its name; state it in {beside.name} beside it, e.g. "
            "'kind: affine_disparity' (or metric, or scale), with mean and std of its colours, see docs/priors.md"
        )
    return spec, " and ".join(where)


def family_of(file: Path) -> tuple[str, dict[str, Any]]:
    """The longest name of a family that a file's name holds, and what its networks take and give; empty if none is."""
    name = re.sub(r"[^a-z0-9]", "", file.stem.lower())
    name = name.replace("depthanything3", "depthanythingv3").replace("da3", "depthanythingv3")
    if "metric" in name:
        name = name.replace("depthanythingv2", "depthanythingv2metric")
    found = max((family for family in FAMILIES if family in name), key=len, default="")
    return found, FAMILIES.get(found, {})
