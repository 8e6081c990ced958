"""Networks in files of ONNX: how one is loaded, what a YAML beside it says, and colours as it takes them.

An ONNX file states names and shapes of inputs and outputs, but neither how colours are scaled nor what the numbers mean
that come out.
"""

import difflib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import draccus
import numpy as np
import yaml
from jaxtyping import Float32, Shaped
from numpy import ndarray

from lerobot_msdyn.core.errors import PriorError, first_line, one_line
from lerobot_msdyn.core.fields import between, problems
from lerobot_msdyn.core.observations import Model
from lerobot_msdyn.priors.models import UNKNOWN_LICENCE
from lerobot_msdyn.render.cpu.threads import threads

NETWORK_SUFFIX, SPEC_SUFFIX = ".onnx", ".yaml"
IMAGENET = {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}

_ERRORS_ONLY = 3  # of onnxruntime's levels of logging

Channels = Literal["rgb", "bgr"]


@dataclass
class PictureSpec:
    """How a network takes colours, and what it is called."""

    # Value of white before mean and std: 1 or 255.
    white: float = between(1.0, 1e-6, 1e6)
    # Of each channel: subtracted from the colours ...
    mean: list[float] = field(default_factory=lambda: [0.0] * 3)
    # ... which are then divided by this.
    std: list[float] = field(default_factory=lambda: [1.0] * 3)
    # Order of the channels.
    channels: Channels = "rgb"
    # Its name, revision and licence, for the log and the output's record.
    model: str = ""
    revision: str = ""
    licence: str = ""

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        colours = ("mean", self.mean), ("std", self.std)
        lines = [f"{name} is {value}; expected 3 numbers" for name, value in colours if len(value) != 3]
        if 0 in self.std:
            lines.append("std has a 0")
        return lines

    def origin(self, name: str, digest: str) -> Model:
        """The record of the network, with a file's or folder's name and digest where nothing else is stated."""
        return Model(self.model or name, self.revision or digest, self.licence or UNKNOWN_LICENCE)

    def normal(self, picture: Shaped[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
        """RGB 0..255 as the network takes it."""
        scaled = picture.astype(np.float32) * np.float32(self.white / 255)
        ordered = scaled[..., ::-1] if self.channels == "bgr" else scaled
        return (ordered - np.array(self.mean, np.float32)) / np.array(self.std, np.float32)


def load_session(file: Path, device: str) -> Any:
    """A network, to be run on a device: cpu, or cuda where onnxruntime was built with it.

    Raises:
        PriorError: onnxruntime cannot load it.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ERRORS_ONLY
    options.intra_op_num_threads = threads()
    wanted = ["CUDAExecutionProvider"] if device == "cuda" else []
    there = onnxruntime.get_available_providers()
    providers = [name for name in (*wanted, "CPUExecutionProvider") if name in there]
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=providers)
    except Exception as error:  # onnxruntime's own kinds have no base but this
        raise PriorError(f"{file} is no network that onnxruntime can load ({first_line(error)})") from error


def decoded[S: PictureSpec](kind: type[S], stated: dict[str, Any], where: str) -> S:
    """A spec of what is stated; `where` names it in errors.

    Raises:
        PriorError: something has the wrong type, or is out of its range.
    """
    try:
        spec: S = draccus.decode(kind, stated)
    except (draccus.utils.DraccusException, TypeError, ValueError, AttributeError) as error:
        raise PriorError(f"{where}: {one_line(error)}") from error
    wrong = problems(spec)
    if wrong:
        raise PriorError(f"{where}: {'; '.join(wrong)}")
    return spec


def read_yaml(path: Path) -> dict[str, Any]:
    """What is stated in a file; nothing where there is none.

    Raises:
        PriorError: it cannot be read, or is no mapping.
    """
    if not path.is_file():
        return {}
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise PriorError(f"{path} cannot be read as YAML ({one_line(error)})") from error
    if not isinstance(content, dict):
        raise PriorError(f"{path} holds {type(content).__name__}; expected a mapping such as 'white: 255'")
    return content


def check_names(where: Path, content: dict[str, Any], kind: type[PictureSpec]) -> None:
    """Whether a spec has all keys that are stated.

    Raises:
        PriorError: it lacks one.
    """
    names = [item.name for item in fields(kind)]
    for name in content:
        if name not in names:
            near = difflib.get_close_matches(str(name), names, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"expected some of {', '.join(names)}"
            raise PriorError(f"{where}: unknown key {name!r}; {hint}")
