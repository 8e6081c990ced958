"""One less the structural similarity of two pictures (Wang et al. 2004), the second half of 3DGS's L_rgb."""

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_msdyn.core.registries import LOSSES
from lerobot_msdyn.reconstruction.loss_terms import FitStep

WINDOW_PX, SIGMA_PX = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


@LOSSES.register("ssim")
def ssim(step: FitStep) -> Float[Tensor, ""]:
    """Between the rendered and the recorded pictures."""
    return ssim_loss(step.rendering.rgb, step.targets.view.rgb[step.frames].to(step.rendering.rgb) / 255)


def ssim_loss(rendered: Float[Tensor, "b h w 3"], recorded: Float[Tensor, "b h w 3"]) -> Float[Tensor, ""]:
    """One less the mean similarity over all pixels and channels, in Gaussian windows; outside is black."""
    x, y = (picture.movedim(-1, 1).flatten(0, 1)[:, None] for picture in (rendered, recorded))
    stack = _blurred(torch.cat((x, y, x * x, y * y, x * y)))
    mean_x, mean_y, square_x, square_y, product = stack.chunk(5)
    variance_x, variance_y = square_x - mean_x.square(), square_y - mean_y.square()
    covariance = product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x.square() + mean_y.square() + C1)
    structure = (2 * covariance + C2) / (variance_x + variance_y + C2)
    return 1 - (luminance * structure).mean()


def _blurred(images: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 h w"]:
    offset = torch.arange(WINDOW_PX, dtype=images.dtype, device=images.device) - WINDOW_PX // 2
    kernel = torch.exp(-(offset**2) / (2 * SIGMA_PX**2))
    kernel = (kernel / kernel.sum())[None, None]
    rows = torch.nn.functional.conv2d(images, kernel[..., None], padding=(WINDOW_PX // 2, 0))
    return torch.nn.functional.conv2d(rows, kernel[:, :, None], padding=(0, WINDOW_PX // 2))
