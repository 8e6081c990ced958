"""What a rasterizer returns, and the constants of the splatting model that every backend shares."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

COVARIANCE_BLUR = 0.3  # px², added to both axes of every projected covariance (low-pass filter)
MIN_ALPHA = 1 / 255  # a Gaussian that covers a pixel by less is skipped there
MAX_ALPHA = 0.999  # cap on the alpha of one Gaussian at one pixel; no gradient flows above it
MIN_TRANSMITTANCE = 1e-4  # a pixel is finished before the Gaussian that would take it to this or less
TANGENT_MARGIN = 0.3  # of half the image's field of view: how far outside the perspective is linearised
MAX_CPU_CHANNELS = 16  # feature channels of one call of the CPU backend
FURTHEST = 1e9  # px; a Gaussian further off or with larger sigmas is not rendered (float32 ends there)
QUAT_LENGTHS = (1e-12, 1e12)  # lengths that a quaternion may have: their squares are ordinary float32 numbers


@dataclass(frozen=True)
class Raster:
    """Images of a batch of views. Colour over a background is `features + (1 - alpha) * background`."""

    features: Float[Tensor, "b h w c"]  # alpha-composited over zero, not divided by alpha
    depth: Float[Tensor, "b h w"]  # m, expected z-depth: sum(w z) / sum(w); 0 where alpha is 0
    alpha: Float[Tensor, "b h w"]  # 0..1, accumulated opacity sum(w)
