"""Depth of single images by a network in a file of ONNX, run by onnxruntime."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError, first_line
from lerobot_msdyn.priors.depth.onnx_spec import OnnxSpec
from lerobot_msdyn.priors.onnx_file import load_session

_COLOURS = 3
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_DEPTH_NAMES = ("predicted_depth", "pred_depth", "depth")  # of outputs, where there are several
_GREY = 127.5  # the border of a padded picture


@dataclass(frozen=True)
class Placed:
    """Where a picture lies in a network's input, in pixels of that input."""

    height: int
    width: int
    top: int = 0
    left: int = 0


class OnnxNetwork:
    """Callable: frames -> what the network says of each."""

    def __init__(self, file: Path, spec: OnnxSpec, device: str) -> None:
        """Load it.

        Args:
            file: the network.
            spec: what it takes and gives.
            device: cpu, or cuda where onnxruntime was built with it.

        Raises:
            PriorError: it is no network that takes one picture.
        """
        self._file, self._spec = file, spec
        self._session = load_session(file, device)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1:
            raise PriorError(f"{file} takes {', '.join(each.name for each in inputs)}; expected one input, a picture")
        self._input = inputs[0].name
        self._type = _TYPES.get(inputs[0].type)
        if self._type is None:
            raise PriorError(f"{file} takes {inputs[0].type}; expected one of {', '.join(_TYPES)}")
        self._output = self._depth_among([each.name for each in outputs])
        self._axes, self._height, self._width = self._input_size(inputs[0].shape)

    def __call__(
        self, rgb: UInt8[Tensor, "t h w 3"], intrinsics: Float[Tensor, "3 3"] | None = None
    ) -> Float[Tensor, "t h w"]:
        """What it says of each frame, at the frames' size; not finite = unknown.

        Args:
            rgb: the frames.
            intrinsics: of their camera, for a network whose metres are those of a certain focal length.

        Raises:
            PriorError: it cannot be run, or gives no image.
        """
        height, width = rgb.shape[1:3]
        place = self._place(height, width)
        frames = []
        for frame in rgb.numpy():
            image = self._run(self._arranged(frame, place))
            rows, columns = image.shape
            down, across = rows / self._height, columns / self._width  # it may give fewer pixels than it takes
            image = image[
                round(place.top * down) : round((place.top + place.height) * down),
                round(place.left * across) : round((place.left + place.width) * across),
            ]
            frames.append(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR))
        values = torch.from_numpy(np.stack(frames))
        if self._spec.focal_px and intrinsics is not None:
            values = values * (float(intrinsics[0, 0]) * place.width / width / self._spec.focal_px)
        return values

    def _depth_among(self, names: list[str]) -> str:
        if self._spec.output:
            if self._spec.output not in names:
                raise PriorError(f"{self._file} gives {', '.join(names)}; output is {self._spec.output!r}")
            return self._spec.output
        known = [name for name in _DEPTH_NAMES if name in names]
        if len(names) > 1 and not known:
            raise PriorError(f"{self._file} gives {', '.join(names)}; which is depth? state output: NAME")
        return known[0] if known else names[0]

    def _input_size(self, shape: list[Any]) -> tuple[str, int, int]:
        """Order of the axes, height and width; axes of any length are given as text or None."""
        colours_last = len(shape) == 4 and shape[3] == _COLOURS and shape[1] != _COLOURS
        axes = {4: "bhwc" if colours_last else "bchw", 5: "bnchw"}.get(len(shape), "")
        lengths = dict(zip(axes, shape, strict=True)) if axes else {}
        one = all(not isinstance(lengths.get(axis), int) or lengths[axis] == 1 for axis in "bn")
        if not axes or not one or (isinstance(lengths["c"], int) and lengths["c"] != _COLOURS):
            raise PriorError(
                f"{self._file} takes an input of shape {shape}; expected one picture, [1, 3, height, width], "
                "[1, height, width, 3] or [1, 1, 3, height, width]"
            )
        stated = dict(zip("hw", self._spec.size, strict=True)) if self._spec.size else {}
        sizes = []
        for axis, name in (("h", "height"), ("w", "width")):
            length = lengths[axis] if isinstance(lengths[axis], int) and lengths[axis] > 0 else stated.get(axis)
            if length is None:
                raise PriorError(
                    f"{self._file} leaves the {name} of its input open; state size: [height, width] in the YAML beside "
                    "it, or --priors.onnx.size '[392,518]'"
                )
            if length != stated.get(axis, length):
                raise PriorError(f"{self._file} takes a {name} of {length} px, but size says {stated[axis]}")
            sizes.append(length)
        return axes, sizes[0], sizes[1]

    def _place(self, height: int, width: int) -> Placed:
        if self._spec.fit == "stretch":
            return Placed(self._height, self._width)
        scale = min(self._height / height, self._width / width)
        inside = round(height * scale), round(width * scale)
        return Placed(*inside, (self._height - inside[0]) // 2, (self._width - inside[1]) // 2)

    def _arranged(self, frame: UInt8[ndarray, "h w 3"], place: Placed) -> ndarray:
        """A frame as the network takes it."""
        smaller = place.width < frame.shape[1]
        size, how = (place.width, place.height), cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        image = np.full((self._height, self._width, _COLOURS), _GREY, np.float32)
        inside = np.s_[place.top : place.top + place.height, place.left : place.left + place.width]
        image[inside] = cv2.resize(frame, size, interpolation=how)
        normal = self._spec.normal(image)
        arranged = normal if self._axes == "bhwc" else normal.transpose(2, 0, 1)
        leading = (None,) * (len(self._axes) - arranged.ndim)
        if self._type is np.uint8:
            arranged = arranged.round()
        return np.ascontiguousarray(arranged[leading].astype(self._type))

    def _run(self, image: ndarray) -> Float32[ndarray, "h w"]:
        try:
            output = np.asarray(self._session.run([self._output], {self._input: image})[0])
        except Exception as error:  # onnxruntime's own kinds have no base but this
            raise PriorError(
                f"{self._file} cannot be run on a picture of {self._height}x{self._width} px ({first_line(error)})"
            ) from error
        inner = [length for length in output.shape if length != 1]
        if len(inner) != 2:
            raise PriorError(
                f"{self._file} gives {self._output} of shape {list(output.shape)}; expected one value per pixel"
            )
        return output.reshape(inner).astype(np.float32)
