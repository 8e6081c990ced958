"""Where points land in a picture, and whether it shows them."""

import torch

from lerobot_msdyn.core.cameras import static_camera
from lerobot_msdyn.core.visibility import projected

# 4 x 2 pixels, one pixel a metre at 1 m, the optical axis through the corner between the middle pixels
CAMERA = static_camera(torch.tensor([[1.0, 0, 2], [0, 1, 1], [0, 0, 1]]), 1, 4, 2)


def test_points_land_on_the_pixel_that_holds_them() -> None:
    points = torch.tensor([[-1.5, -0.5, 1.0], [2.0, 1.0, 2.0], [0.0, 0.0, 3.0]])
    found = projected(points, CAMERA)
    assert [each.tolist() for each in found.pixel] == [[0, 1, 1], [0, 3, 2]]
    assert found.inside.all()
    torch.testing.assert_close(found.xy, torch.tensor([[0.5, 0.5], [3.0, 1.5], [2.0, 1.0]]))


def test_what_is_outside_has_the_nearest_pixel_of_the_border_and_is_never_visible() -> None:
    left, right, below, behind = [-2.1, 0.1, 1.0], [2.0, 0.1, 1.0], [0.1, 5.0, 1.0], [0.1, 0.1, -1.0]
    found = projected(torch.tensor([left, right, below, behind, [torch.nan] * 3]), CAMERA)
    assert not found.inside.any()
    assert not found.visible(torch.full((2, 4), 100.0)).any()
    row, column = found.pixel
    assert (row.tolist()[:3], column.tolist()[:3]) == ([1, 1, 1], [0, 3, 2])
    assert (row >= 0).all()
    assert (column < 4).all()


def test_a_point_is_visible_unless_it_lies_behind_the_surface_at_its_pixel() -> None:
    depth = torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 2.0, 1.0]])
    z = torch.tensor([0.5, 1.0, 1.005, 1.02, 1.999])
    before_the_near_pixel = torch.stack((-0.5 * z, -0.5 * z, z), dim=-1)
    assert projected(before_the_near_pixel, CAMERA).visible(depth).tolist() == [True, True, True, False, False]
    assert projected(before_the_near_pixel, CAMERA).visible(depth, 0.0).tolist() == [True, False, False, False, False]
    before_the_far_pixel = torch.stack((0.5 * z, 0.5 * z, z), dim=-1)
    assert projected(before_the_far_pixel, CAMERA).visible(depth).all()
