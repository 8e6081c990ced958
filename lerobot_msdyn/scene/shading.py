"""How bright every Gaussian is at every time, relative to its own colour: moving shadows, exposure, and shading."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

GAIN_OCTAVES = 1.0  # gains lie between 1/2 and 2 ...
NEUTRAL = 128  # the code of one
_STEPS = 127  # ... in so many equal steps of their logarithm to either side


def encode_gain(gain: Float[Tensor, "*any"]) -> UInt8[Tensor, "*any"]:
    """Gains as bytes; a step is 0.55 %."""
    octaves = gain.clamp(min=1e-6).log2().clamp(-GAIN_OCTAVES, GAIN_OCTAVES)
    return (octaves * (_STEPS / GAIN_OCTAVES) + NEUTRAL).round().to(torch.uint8)


def decode_gain(code: UInt8[Tensor, "*any"] | Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """What `encode_gain` encoded; codes may have been interpolated."""
    return torch.exp2((code.float() - NEUTRAL) * (GAIN_OCTAVES / _STEPS))


@dataclass(frozen=True)
class Shading:
    """Brightness of the static and the moving set over time.

    What falls on a surface does not depend on who looks: gains belong to Gaussians, and are as valid from another
    camera. For the static set they are kept as small images of the recorded camera (of all directions, where it moves),
    in which every Gaussian has its place, so that memory does not grow with the number of Gaussians times the number of
    frames.
    """

    field: UInt8[Tensor, "t h w"]  # gains of the static set, coded, in the recorded camera's image
    places: Float[Tensor, "g 2"]  # where each static Gaussian is in it, -1..1 (x, y)
    moving: UInt8[Tensor, "t m"]  # gains of the moving set, coded

    def static_gain(self, times: Float[Tensor, " b"] | Int[Tensor, " b"]) -> Float[Tensor, "b g"]:
        """Gains of the static Gaussians at some times (frames)."""
        images = _between(self.field, times)[:, None]
        grid = self.places[None, None].expand(len(times), -1, -1, -1)
        codes = torch.nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)
        return decode_gain(codes[:, 0, 0])

    def moving_gain(self, times: Float[Tensor, " b"] | Int[Tensor, " b"]) -> Float[Tensor, "b m"]:
        """Gains of the moving Gaussians at some times (frames)."""
        return decode_gain(_between(self.moving, times))


def _between(codes: UInt8[Tensor, "t *any"], times: Tensor) -> Float[Tensor, "b *any"]:
    """Codes at times between frames; held before the first and after the last."""
    time = times.to(codes.device).float().clamp(0, len(codes) - 1)
    before = time.floor().long()
    fraction = (time - before).reshape(-1, *[1] * (codes.dim() - 1))
    first = codes[before].float()
    if not fraction.is_cuda and not bool(fraction.any()):  # on a GPU, waiting for the answer takes longer
        return first
    return torch.lerp(first, codes[(before + 1).clamp(max=len(codes) - 1)].float(), fraction)


def no_shading(static: int, moving: int, frames: int) -> Shading:
    """Gains of one everywhere and at all times."""
    field = torch.full((frames, 1, 1), NEUTRAL, dtype=torch.uint8)
    return Shading(field, torch.zeros(static, 2), torch.full((frames, moving), NEUTRAL, dtype=torch.uint8))
