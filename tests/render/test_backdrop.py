"""A backdrop is rendered as if its Gaussians were given with the others."""

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_msdyn.core.errors import RenderError
from lerobot_msdyn.render import Painted, Raster, project_backdrop, rasterize

STILL, OTHERS, WIDTH, HEIGHT, VIEWS = 200, 150, 130, 70, 3


@pytest.fixture
def still(make_scene):
    """Gaussians, some of them on the borders of the picture, some behind the camera, and the camera."""
    scene = make_scene(count=STILL, width=WIDTH, height=HEIGHT, seed=1)
    scene.gaussians[0][:5, 2] *= -1
    return scene


@pytest.fixture
def others(make_scene):
    """Those before and behind which they are."""
    return make_scene(count=OTHERS, width=WIDTH, height=HEIGHT, seed=2)


def painted(still: Any, *, gains: Tensor | None = None, hidden: Tensor | None = None, once: bool = False) -> Painted:
    """The backdrop of a scene, by default in its own colours and whole."""
    *gaussians, features = still.gaussians
    arguments: Any = (*gaussians, still.poses[0], still.intrinsics[0], WIDTH, HEIGHT)
    backdrop = project_backdrop(*arguments, backend="cpu", once=once)
    gains = torch.ones(STILL) if gains is None else gains
    hidden = torch.zeros(STILL, dtype=torch.bool) if hidden is None else hidden
    return Painted(backdrop, features, gains, hidden)


def together(still: Any, others: Any, intrinsics: Tensor, width: int, height: int) -> Raster:
    """One picture of all Gaussians."""
    gaussians = [torch.cat(pair) for pair in zip(still.gaussians, others.gaussians, strict=True)]
    arguments: Any = (*gaussians, still.poses, intrinsics, width, height)
    return rasterize(*arguments, backend="cpu")


def seen(still: Any, others: Any, backdrop: Painted | None, **changed: Any) -> Raster:
    """A picture of the others before a backdrop, by the camera of what is still, but for what is changed of it."""
    given = {"poses": still.poses, "intrinsics": still.intrinsics, "size": (WIDTH, HEIGHT)} | changed
    arguments: Any = (*others.gaussians, given.pop("poses"), given.pop("intrinsics"), *given.pop("size"))
    return rasterize(*arguments, **({"backend": "cpu"} | given), backdrop=backdrop)


def assert_same(one: Raster, other: Raster, atol: float = 0) -> None:
    for name, values in vars(one).items():
        torch.testing.assert_close(getattr(other, name), values, atol=atol, rtol=0)


def test_pictures_are_those_of_all_gaussians_to_the_bit(still, others):
    expected = together(still, others, still.intrinsics, WIDTH, HEIGHT)
    assert_same(expected, seen(still, others, painted(still)))
    assert expected.alpha.max() > 0.9
    assert (seen(still, others, None).alpha - expected.alpha).abs().max() > 0.5, "the backdrop is seen"


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("once", [False, True])
def test_gains_and_what_is_hidden_may_be_of_each_view(still, others, backend, once):
    gains = torch.linspace(0.5, 1.5, VIEWS * STILL).reshape(VIEWS, STILL)
    hidden = torch.arange(VIEWS * STILL).reshape(VIEWS, STILL) % 3 == 0
    views = {"poses": still.poses.expand(VIEWS, 4, 4), "intrinsics": still.intrinsics.expand(VIEWS, 3, 3)}
    backdrop = painted(still, gains=gains, hidden=hidden, once=once)
    drawn = seen(still, others, backdrop, **views, backend=backend)
    means, quats, scales, opacities, features = still.gaussians
    for view in range(VIEWS):
        shown = ~hidden[view]
        lit = (features * gains[view, :, None])[shown]
        left = dataclasses.replace(still, gaussians=(means[shown], quats[shown], scales[shown], opacities[shown], lit))
        expected = together(left, others, still.intrinsics, WIDTH, HEIGHT)
        assert_same(expected, Raster(*(values[view : view + 1] for values in vars(drawn).values())), atol=5e-5)


def test_others_are_learned_before_it(still, others):
    leaves = [values.clone().requires_grad_() for values in others.gaussians]
    learned = dataclasses.replace(others, gaussians=tuple(leaves))
    gradients = []
    for raster in (
        together(still, learned, still.intrinsics, WIDTH, HEIGHT),
        seen(still, learned, painted(still)),
    ):
        (raster.features.square().sum() + raster.depth.sum()).backward()
        gradients.append([leaf.grad.clone() for leaf in leaves])
        for leaf in leaves:
            leaf.grad = None
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)


def test_what_is_not_seen_at_all(still, others):
    means, *rest = still.gaussians
    aside = dataclasses.replace(still, gaussians=(-means.abs(), *rest))
    assert_same(seen(still, others, None), seen(still, others, painted(aside)))


def test_what_does_not_fit_is_named(still, others):
    backdrop = painted(still)
    moved = still.poses.clone()
    moved[0, 0, 3] += 0.1
    learned, wider = still.poses.clone().requires_grad_(), still.intrinsics + torch.eye(3)
    for wrong in (
        {"poses": moved},
        {"near": 0.2},
        {"poses": learned},
        {"intrinsics": wider},
        {"size": (WIDTH - 1, HEIGHT)},
    ):
        with pytest.raises(RenderError, match="was projected for another pose"):
            seen(still, others, backdrop, **wrong)
    with pytest.raises(RenderError, match=r"features of the backdrop have shape \[200, 2\]; expected \[200, 3\]"):
        seen(still, others, dataclasses.replace(backdrop, plain=backdrop.plain[:, :2]))
    with pytest.raises(
        RenderError, match=r"hidden of the backdrop have shape \[2, 200\]; expected \[200\], or \[1, 200"
    ):
        seen(still, others, dataclasses.replace(backdrop, hidden=torch.zeros(2, STILL, dtype=torch.bool)))
    splats, bad = backdrop.backdrop.splats, backdrop.plain.clone()
    assert splats is not None
    first = int(splats.sources[0])
    bad[first, 1] = float("nan")
    with pytest.raises(RenderError, match=r"the backdrop's features at index .* is nan; expected a finite number"):
        seen(still, others, dataclasses.replace(backdrop, plain=bad))
    arguments: Any = (*still.gaussians[:4], still.poses[0], still.intrinsics[0], WIDTH, HEIGHT)
    with pytest.raises(RenderError, match=r"near is 0\.0 m; expected a positive distance"):
        project_backdrop(*arguments, near=0.0)
    with pytest.raises(RenderError, match="backend is 'gpu'; expected one of auto, reference, cpu, cuda"):
        project_backdrop(*arguments, backend="gpu")
    still.gaussians[3][4] = 2.0
    with pytest.raises(RenderError, match=r"opacities at index \[4\] is 2; expected 0..1"):
        painted(still)
