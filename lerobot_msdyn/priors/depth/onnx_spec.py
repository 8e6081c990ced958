"""What a depth network in a file of ONNX takes and gives: by a YAML file beside it, by settings, or by its name.

An ONNX file states names and shapes of inputs and outputs, but neither how colours are scaled nor what the numbers mean
that come out.
"""

import difflib
import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import draccus
import yaml

from lerobot_msdyn.core.errors import PriorError, one_line
from lerobot_msdyn.core.fields import between, problems

NETWORK_SUFFIX, SPEC_SUFFIX = ".onnx", ".yaml"
IMAGENET = {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}
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
Channels = Literal["rgb", "bgr"]
Fit = Literal["stretch", "pad"]


@dataclass
class OnnxSpec:
    """What a network takes and gives."""

    # metric (m), scale (depth that lacks a factor), affine_disparity (inverse depth that lacks factor and shift).
    kind: Kind = ""
    # [height, width] of its input in pixels, where the file leaves that open.
    size: list[int] = field(default_factory=list)
    # Value of white before mean and std: 1 or 255.
    white: float = between(1.0, 1e-6, 1e6)
    # Of each channel: subtracted from the colours ...
    mean: list[float] = field(default_factory=lambda: [0.0] * 3)
    # ... which are then divided by this.
    std: list[float] = field(default_factory=lambda: [1.0] * 3)
    # Order of the channels.
    channels: Channels = "rgb"
    # stretch the picture to the input's size, or pad it with grey.
    fit: Fit = "stretch"
    # Of a metric one: the focal length (px of its input) of the camera whose metres these are; 0: any camera's.
    focal_px: float = between(0.0, 0, 1e6)
    # Name of its output that is depth, where it has several.
    output: str = ""
    # Its name, revision and licence, for the log and the output's record.
    model: str = ""
    revision: str = ""
    licence: str = ""

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        lines = [f"{name} is {value}; expected 3 numbers" for name, value in self._colours() if len(value) != 3]
        if 0 in self.std:
            lines.append("std has a 0")
        if self.size and (len(self.size) != 2 or min(self.size) < 1):
            lines.append(f"size is {self.size}; expected [height, width] in px")
        if self.focal_px and self.kind not in ("", "metric"):
            lines.append(f"focal_px is {self.focal_px:g}, but kind is {self.kind}; expected it of metric depth alone")
        return lines

    def _colours(self) -> tuple[tuple[str, list[float]], ...]:
        return ("mean", self.mean), ("std", self.std)


def read_spec(file: Path, settings: dict[str, Any]) -> tuple[OnnxSpec, str]:
    """What is known of a network, and from where: settings go before the YAML beside it, this before its name.

    Raises:
        PriorError: neither says of which kind its depth is, or something said is unknown or of the wrong type.
    """
    beside = file.with_suffix(SPEC_SUFFIX)
    family, known = family_of(file)
    stated = _read_yaml(beside) if beside.is_file() else {}
    origins = [f"as {family} networks", f"by {beside.name}", "by priors.onnx"]
    parts = [known, stated, settings]
    where = [origin for origin, part in zip(origins, parts, strict=True) if part]
    _check_names(beside, stated)
    _check_names(Path("priors.onnx"), settings)
    try:
        spec: OnnxSpec = draccus.decode(OnnxSpec, known | stated | settings)
    except (draccus.utils.DraccusException, TypeError, ValueError, AttributeError) as error:
        raise PriorError(f"{file} {' and '.join(where)}: {one_line(error)}") from error
    wrong = problems(spec)
    if wrong:
        raise PriorError(f"{file} {' and '.join(where)}: {'; '.join(wrong)}")
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


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise PriorError(f"{path} cannot be read as YAML ({one_line(error)})") from error
    if not isinstance(content, dict):
        raise PriorError(f"{path} holds {type(content).__name__}; expected a mapping such as 'kind: metric'")
    return content


def _check_names(where: Path, content: dict[str, Any]) -> None:
    names = [item.name for item in fields(OnnxSpec)]
    for name in content:
        if name not in names:
            near = difflib.get_close_matches(str(name), names, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"expected some of {', '.join(names)}"
            raise PriorError(f"{where}: unknown key {name!r}; {hint}")
