"""A CUDA device that is not there: tensors without values, which tell what is copied from it and what is waited for.

No tensor of the host can take part there, as on a GPU; masks select nothing there, since what they select is not known.
What is read from it is one or true.
"""

import traceback
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

import lerobot_msdyn
from lerobot_msdyn.render import Painted, Raster

_ANSWERS: dict[str, Callable[[Tensor], Any]] = {
    "__bool__": lambda _: True,
    "__float__": lambda _: 1.0,
    "item": lambda _: 1.0,
    "__int__": lambda _: 1,
    "__index__": lambda _: 1,
    "tolist": lambda values: torch.ones(values.shape, dtype=values.dtype).tolist(),
}


class FakeGpu(TorchFunctionMode):
    """Within, the device cuda can be used; `waits` and `copies` say what made the host wait, and what copied."""

    def __init__(self) -> None:
        super().__init__()
        self.mode = FakeTensorMode()
        self.waits: list[str] = []
        self.copies: list[str] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        first = args[0] if args else None
        if isinstance(first, FakeTensor):
            if name == "backward":  # autograd asks for a real device; it mixes none that the forward pass does not
                return None
            if name in _ANSWERS:
                self.waits.append(_caller())
                return _ANSWERS[name](first)
            if name == "cpu" or (name == "to" and torch.device("cpu") in _devices(args[1:], kwargs)):
                self.copies.append(_caller())
                return torch.ones(first.shape, dtype=first.dtype)
            if name == "nonzero":  # of one dimension: all of it
                self.waits.append(_caller())
                with self.mode:
                    return torch.arange(len(first), device=first.device)[:, None]
        if torch.device("cuda") in _devices(args, kwargs):  # copied to it, or made there
            with self.mode:
                if isinstance(first, Tensor) and not isinstance(first, FakeTensor):
                    args = (self.mode.from_tensor(first), *args[1:])
                return func(*args, **kwargs)
        if any(isinstance(value, FakeTensor) for value in tree_leaves((args, kwargs))):
            with self.mode:  # refuses tensors of the host, but for those of one number
                return func(*args, **kwargs)
        return func(*args, **kwargs)


def _devices(args: Any, kwargs: dict) -> list[torch.device]:
    """What of the arguments names a device, without its index."""
    given = [value for value in (*args, kwargs.get("device")) if isinstance(value, torch.device | str)]
    return [torch.device(torch.device(value).type) for value in given if str(value).split(":")[0] in ("cpu", "cuda")]


def _caller() -> str:
    """The line of the package that is being run, as "file function"."""
    package = lerobot_msdyn.__path__[0]
    frames = [frame for frame in traceback.extract_stack() if frame.filename.startswith(package)]
    return f"{frames[-1].filename.removeprefix(package + '/')} {frames[-1].name}" if frames else "test"


def fake_rasterize(*arguments: Any, near: float, backend: str = "auto", backdrop: Painted | None = None) -> Raster:
    """In place of `rasterize`: as wide and as differentiable, of no meaning; all tensors must be on the fake GPU."""
    *tensors, width, height = arguments
    behind = [] if backdrop is None else [backdrop.features, backdrop.opacities, backdrop.backdrop.means]
    assert {each.device.type for each in (*tensors, *behind)} == {"cuda"}, [each.device for each in tensors]
    views, channels = len(tensors[5]), tensors[4].shape[-1]
    everything = torch.stack([tensor.sum() for tensor in tensors]).sum()
    image = everything.expand(views, height, width, channels + 2)
    return Raster(image[..., :channels], image[..., channels], image[..., channels + 1])
