"""Which Gaussians some pixels may show, against the slow renderer."""

import numpy as np
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.render import rasterize
from lerobot_msdyn.scene.footprints import footprints


def test_all_that_may_cover_some_pixels_is_found() -> None:
    """Without the others, those pixels are the same."""
    generator, count = torch.Generator().manual_seed(0), 400
    camera = static_camera(intrinsics_from_fov(48, 32, 70.0), 1, 48, 32)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([4.0, 3, 3]) - torch.tensor([2, 1.5, 1])
    scales = torch.rand(count, 3, generator=generator).pow(3) * 0.3 + 0.005
    quats = torch.randn(count, 4, generator=generator)
    colours, opacities = torch.rand(count, 3, generator=generator), torch.full((count,), 0.7)
    where = np.zeros((32, 48), bool)
    where[5:9, 30:35] = True
    found = footprints(means, scales.amax(-1), camera).may_cover(where)
    assert 0 < int(found.sum()) < 0.9 * int((means[:, 2] > 0).sum())

    def shown(which: torch.Tensor) -> torch.Tensor:
        picture = rasterize(
            means[which], quats[which], scales[which], opacities[which], colours[which],
            camera.camera_from_world, camera.intrinsics, 48, 32, near=0.01, backend="reference",
        )  # fmt: skip
        return picture.features[0][torch.from_numpy(where)]

    torch.testing.assert_close(shown(found), shown(torch.ones_like(found)), atol=1e-6, rtol=0)
