"""How providers are chosen, with providers of this test: a new one takes part without a change elsewhere."""

import inspect
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import CameraConfig, PriorsConfig, Recipe
from lerobot_msdyn.core.errors import ConfigError, PriorError
from lerobot_msdyn.core.observations import DepthTraits, Model, Origin, PointTracks, View
from lerobot_msdyn.core.registry import Registry
from lerobot_msdyn.priors.cache import PriorCache
from lerobot_msdyn.priors.from_file import DepthFile
from lerobot_msdyn.priors.provide import best, provide
from lerobot_msdyn.priors.registry import (
    CAMERAS,
    DEPTH,
    MASKS,
    TRACKS,
    CameraProvider,
    Depth,
    DepthProvider,
    Estimate,
    MaskProvider,
    Masks,
    Provider,
    TrackProvider,
    Unusable,
)
from lerobot_msdyn.priors.request import Request

T, H, W = 3, 6, 8
VIEW = View(torch.zeros(T, H, W, 3, dtype=torch.uint8), static_camera(intrinsics_from_fov(W, H, 60.0), T, W, H))
STILL = torch.zeros(T, H, W, dtype=torch.uint8)
KINDS: dict[type[Provider], Registry] = {
    MaskProvider: MASKS,
    CameraProvider: CAMERAS,
    DepthProvider: DEPTH,
    TrackProvider: TRACKS,
}


@pytest.fixture(autouse=True)
def _forgotten_afterwards() -> Iterator[None]:
    """What a test registers is not there for the next."""
    before = {kind: registry.all() for kind, registry in KINDS.items()}
    yield
    for kind, registry in KINDS.items():
        registry._registered = before[kind]


class Lidar(DepthProvider):
    """Two metres everywhere."""

    rank = 100

    def usable(self, request: Request) -> str:
        return "there is a lidar"

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        z = torch.full(instances.shape, 2.0)
        return Estimate(Depth(z, DepthTraits(metric=True)), "by echo", Model("me/lidar", licence="MIT"))


class Broken(Lidar):
    """Fails on this video."""

    rank = 200

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        raise PriorError("the echo is lost")


class Absent(Lidar):
    """Cannot be used."""

    rank = 300

    def usable(self, request: Request) -> str:
        raise Unusable("no lidar is plugged in", "plug it in")


def request() -> Request:
    return Request(VIEW, PriorsConfig(), CameraConfig(), PriorCache(None))


def depth(wanted: str = "auto") -> tuple[Depth, Origin]:
    return provide(DepthProvider, wanted, request(), lambda it: it.estimate(request(), STILL), file=DepthFile)


def test_a_new_provider_takes_part_in_auto_by_its_rank() -> None:
    DEPTH.add("lidar", Lidar)
    value, origin = depth()
    assert origin == Origin("lidar", "there is a lidar; by echo", Model("me/lidar", licence="MIT"))
    assert origin.line == "lidar (me/lidar, MIT): there is a lidar; by echo"
    assert origin.entry() == {
        "provider": "lidar",
        "why": "there is a lidar; by echo",
        "model": "me/lidar",
        "licence": "MIT",
    }
    assert value.traits == DepthTraits(metric=True)
    DEPTH.add("sonar", type("Sonar", (Lidar,), {"rank": None}))
    DEPTH.add("radar", type("Radar", (Lidar,), {"rank": 400, "needs_whole_videos": True}))
    assert depth()[1].provider == "lidar"
    assert depth("radar")[1].why == "asked for; by echo"


def test_auto_goes_on_and_says_why(caplog: pytest.LogCaptureFixture) -> None:
    DEPTH.add("absent", Absent)
    DEPTH.add("broken", Broken)
    DEPTH.add("lidar", Lidar)
    with caplog.at_level(logging.INFO):
        origin = depth()[1]
    assert origin.provider == "lidar"
    assert origin.why == ("no lidar is plugged in, broken cannot be used (the echo is lost); there is a lidar; by echo")
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("WARNING", "depth: broken cannot be used: the echo is lost")
    ]


def test_what_was_asked_for_by_name_stops() -> None:
    DEPTH.add("absent", Absent)
    DEPTH.add("broken", Broken)
    with pytest.raises(PriorError, match=r"^priors\.depth is 'absent', but no lidar is plugged in; plug it in$"):
        depth("absent")
    with pytest.raises(PriorError, match=r"^the echo is lost$"):
        depth("broken")
    with pytest.raises(
        ConfigError, match="no depth provider 'lidar'; expected one of absent, broken, depth_anything, "
    ):
        depth("lidar")


def test_where_none_can_be_used_all_reasons_are_given() -> None:
    DEPTH.add("absent", Absent)
    DEPTH.add("broken", Broken)
    with pytest.raises(PriorError, match=r"no provider can be used: no lidar is plugged in, broken .*the echo is lost"):
        best(
            DepthProvider,
            request(),
            lambda it: it.estimate(request(), STILL),
            among=lambda it: issubclass(it, Lidar),
        )


@pytest.mark.parametrize(
    ("kind", "value", "message"),
    [
        (DepthProvider, torch.ones(T, H, W), "a Tensor; expected a Depth"),
        (
            DepthProvider,
            Depth(torch.ones(T, H, 2), DepthTraits()),
            "shape .3, 6, 2., torch.float32; expected .3, 6, 8.",
        ),
        (DepthProvider, Depth(torch.full((T, H, W), torch.nan), DepthTraits()), "negative, infinite or NaN"),
        (DepthProvider, Depth(torch.full((T, H, W), -1.0), DepthTraits()), "negative, infinite or NaN"),
        (MaskProvider, torch.zeros(T, H, W), "torch.float32; expected .3, 6, 8., torch.uint8"),
        (MaskProvider, [1], "a list; expected a tensor"),
        (TrackProvider, (torch.zeros(2, T + 1, 2), torch.ones(2)), "tracks of 4 frames; the video has 3"),
        (TrackProvider, (torch.zeros(2, T, 2), torch.tensor([1, 0])), "tracks of instance 0"),
        (CameraProvider, VIEW.camera.select(slice(2)), "2 frames of 8x6 px; the video has 3 frames of 8x6 px"),
        (CameraProvider, None, "a NoneType; expected a CameraTrack"),
    ],
)
def test_what_a_provider_returns_is_checked(kind: type[Provider], value: object, message: str) -> None:
    if isinstance(value, tuple):
        seen = torch.ones(value[0].shape[:2])
        value = PointTracks(value[0], seen.bool(), seen, value[1].long())

    class Careless(kind):  # type: ignore[misc, valid-type]
        def estimate(self, *_: object) -> Estimate:
            return Estimate(value)

    def run(provider: Any) -> Estimate:  # each kind's `estimate` takes arguments of its own
        return provider.estimate(request())

    KINDS[kind].add("careless", Careless)
    with pytest.raises(PriorError, match=f"the {KINDS[kind].kind} 'careless' returned .*{message}"):
        provide(kind, "careless", request(), run, file=lambda pattern: Careless())


class NoEstimate(DepthProvider):
    """Lacks its method."""


@pytest.mark.parametrize("wrong", [NoEstimate, Lidar(), int, "lidar"])
def test_what_is_no_provider_is_named(wrong: object, caplog: pytest.LogCaptureFixture) -> None:
    DEPTH.add("wrong", wrong)  # type: ignore[arg-type]
    expected = "depth provider 'wrong' is .*; expected a class derived from DepthProvider with a method `estimate`"
    with pytest.raises(ConfigError, match=expected):
        depth("wrong")
    assert depth()[1].provider == "plane"
    assert "wrong is left out: depth provider 'wrong' is" in caplog.text


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_built_in_file_registers_a_provider(kind: type[Provider]) -> None:
    registry = KINDS[kind]
    built_in = registry.all()
    assert registry is kind.registry
    for name, provider in built_in.items():
        assert issubclass(provider, kind), name
        assert not inspect.isabstract(provider), name
        assert provider.__module__ == f"{registry.folder}.{name}"
        make: Callable[..., Provider] = provider
        assert (make("FILE") if provider.parameter else make()).problem(None, VIEW) != ""
    ranks = [provider.rank for provider in built_in.values() if provider.rank is not None]
    assert len(ranks) == len(set(ranks)) > 0
    folder = Path(inspect.getfile(provider)).parent
    assert {path.stem for path in folder.glob("*.py")} == {*built_in, "__init__"}


def test_which_recipes_decode_recorded_depth() -> None:
    reads = {name: PriorsConfig(depth=name).reads_recorded_depth for name in (*DEPTH.names(), "auto", "x.npz")}
    assert [name for name, needed in reads.items() if not needed] == ["parallax", "plane"]
    DEPTH.add("lidar", type("Blind", (Lidar,), {"reads_recorded_depth": False}))
    assert not PriorsConfig(depth="lidar").reads_recorded_depth


def test_which_recipes_need_whole_videos() -> None:
    recipe = Recipe()
    assert not recipe.needs_whole_videos
    assert not replace(recipe, camera=CameraConfig(poses="fixed")).needs_whole_videos
    assert replace(recipe, camera=CameraConfig(poses="sfm")).needs_whole_videos
    assert replace(recipe, priors=PriorsConfig(masks="{episode}.npz")).needs_whole_videos
    DEPTH.add("lidar", type("Slow", (Lidar,), {"needs_whole_videos": True}))
    assert replace(recipe, priors=PriorsConfig(depth="lidar")).needs_whole_videos
