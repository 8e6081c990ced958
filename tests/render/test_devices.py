"""Fit, scores and rendering on a GPU: nothing of the host is mixed in, and what the host waits for is known."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_gpu import FakeGpu, fake_rasterize
from torch import Tensor

from lerobot_msdyn.core.cameras import intrinsics_from_fov, static_camera
from lerobot_msdyn.core.config import FitConfig
from lerobot_msdyn.core.observations import DepthTraits, View
from lerobot_msdyn.core.perturbation import LEVEL
from lerobot_msdyn.core.serialise import to_device
from lerobot_msdyn.motion.model.bases import level_from_motions
from lerobot_msdyn.priors import PointTracks, Priors
from lerobot_msdyn.priors.camera.stands import Stand, Stands
from lerobot_msdyn.reconstruction.background import EmptyScene, background_gaussians
from lerobot_msdyn.reconstruction.evidence import evidence_of
from lerobot_msdyn.reconstruction.fit import FitResult, fit
from lerobot_msdyn.reconstruction.key_views import fixed_view
from lerobot_msdyn.reconstruction.make_overlay import overlay_of
from lerobot_msdyn.reconstruction.make_short_lived import short_lived_of
from lerobot_msdyn.reconstruction.result import FittedWindow, Reconstruction
from lerobot_msdyn.reconstruction.self_check import self_check
from lerobot_msdyn.scene import rendering
from lerobot_msdyn.scene.dynamic import DynamicScene
from lerobot_msdyn.views.gate import judge
from lerobot_msdyn.views.pictures import GPU_BATCH, coverages, for_many_views, new_pictures

pytestmark = pytest.mark.slow

FRAMES, WIDTH, HEIGHT = 12, 32, 24
STEPS = 52  # held-out frames are looked at every 50 steps
SQUARE = (slice(8, 16), slice(10, 20))
GPU = torch.device("cuda")


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> FakeGpu:
    """A GPU that is not there."""
    monkeypatch.setattr(rendering, "rasterize", fake_rasterize)
    return FakeGpu()


def video() -> tuple[View, Priors]:
    """A grey wall 1 m away; a square of it is said to move."""
    rgb = torch.full((FRAMES, HEIGHT, WIDTH, 3), 120, dtype=torch.uint8)
    camera = static_camera(intrinsics_from_fov(WIDTH, HEIGHT, 60.0), FRAMES, WIDTH, HEIGHT)
    instances = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    instances[:, *SQUARE] = 1
    xy = torch.tensor([15.0, 12.0]).expand(1, FRAMES, 2)
    seen, weight = torch.ones(1, FRAMES, dtype=torch.bool), torch.ones(1, FRAMES)
    tracks = PointTracks(xy, seen, weight, torch.ones(1, dtype=torch.long))
    return View(rgb, camera), Priors(torch.ones(FRAMES, HEIGHT, WIDTH), instances, tracks, DepthTraits(metric=True))


def scene_of(view: View) -> DynamicScene:
    """The wall, and a square that shifts by up to 1 cm."""
    static = background_gaussians(view.rgb[0], torch.ones(HEIGHT, WIDTH), view.camera, 10_000)
    inside = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    inside[SQUARE] = True
    moving = static.select(inside.reshape(-1))
    motions = torch.eye(4).repeat(1, FRAMES, 1, 1)
    motions[0, :, 0, 3] = torch.linspace(0, 0.01, FRAMES)
    level = level_from_motions(motions, torch.zeros(1, 3))
    count = len(moving)
    return DynamicScene(
        static, moving, (level,), (torch.zeros(count, 1, dtype=torch.long),), (torch.zeros(count, 1),), FRAMES
    )


def fitted(view: View, priors: Priors) -> FitResult:
    config = FitConfig(steps=STEPS, held_out_frames=1, sh_degree=1)
    scene = to_device(scene_of(view), GPU)
    return fit(scene, view, priors, config, empty=view.rgb[0], distance=1.0, seed=0)


def test_a_fit_stays_on_the_gpu(gpu: FakeGpu) -> None:
    with gpu:
        result = fitted(*video())
    assert result.steps == STEPS
    assert result.scene.device.type == "cuda"
    waits = Counter(gpu.waits)
    every_step = {place for place, count in waits.items() if count >= STEPS}
    assert every_step == {"reconstruction/fit.py _check"}  # that the loss is finite
    assert set(waits) - every_step == {
        "motion/model/bases.py _moves",
        "motion/model/bases.py _at_frames",
        "reconstruction/fit.py psnr",
        "reconstruction/fit.py _result",
    }
    per_measured_frame = {
        "core/serialise.py to_device",
        "reconstruction/brightness.py _seen_sums",
        "reconstruction/fit.py fit",
    }
    assert {place for place, count in Counter(gpu.copies).items() if count > FRAMES} <= per_measured_frame


def test_what_is_made_of_a_fit(gpu: FakeGpu) -> None:
    view, priors = video()
    empty = EmptyScene(view.rgb[0], priors.depth[0], torch.full((HEIGHT, WIDTH), FRAMES))
    with gpu:
        result = fitted(view, priors)
        seen = evidence_of(result.scene, view.camera, fixed_view(empty, view.camera))
        check = self_check(result.scene, view, priors, result.held_out, 1.0)
        short = to_device(short_lived_of(result.scene, view, priors, 2), GPU)
        scene_of_both = replace(result.scene, short_lived=short)
        overlay = to_device(overlay_of(scene_of_both, view, priors), GPU)
        result = replace(result, scene=replace(scene_of_both, overlay=overlay))
        host = to_device((result.scene, seen), "cpu")
        window = FittedWindow(0, *host, check, STEPS, 0.0, {})
        stands = Stands((Stand(0, len(view), 0.0),))
        scene = Reconstruction((window,), True, {}, view.camera, 1.0, LEVEL, stands)
        ready = for_many_views(scene, GPU)
        gpu.waits.clear()
        gpu.copies.clear()
        pictures = list(new_pictures(ready, view.camera, fill="none"))
        waits, copies = Counter(gpu.waits), Counter(gpu.copies)
        filled = list(new_pictures(ready, view.camera))
        scores = judge(ready.windows, view.camera)
        shares = [coverage.unseen_share for coverage in coverages(ready, view.camera)]
    assert all(tensor.device.type == "cpu" for tensor in host[0].tensors().values())
    assert len(pictures) == len(filled) == len(shares) == FRAMES
    assert np.isfinite(scores.expected_db)
    waits.pop("scene/overlay.py _first")
    waits.pop("scene/short_lived.py _first")
    patches = {"scene/dynamic.py patch": FRAMES}
    assert waits == patches | {"motion/model/bases.py _moves": 1, "motion/model/bases.py _at_frames": 2}
    batches = -(-FRAMES // GPU_BATCH)
    assert copies == {"core/serialise.py to_device": 4 * batches}  # coverage and holes, pictures and depth


def test_values_keep_their_structure() -> None:
    view, priors = video()
    moved: dict[str, list[Tensor | None]] = to_device({"a": [view.rgb, None]}, torch.device("meta"))
    assert moved["a"][0] is not None
    assert moved["a"][0].device.type == "meta"
    assert moved["a"][1] is None
    assert to_device((priors, 3, "x"), "cpu")[1:] == (3, "x")
    assert torch.equal(to_device(priors, "cpu").depth, priors.depth)
