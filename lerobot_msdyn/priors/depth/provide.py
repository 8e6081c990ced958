"""Which provider of depth is run, and its result: z-depth (m, 0 = unknown), and whether its metres are true."""

import functools
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import DepthTraits, Origin
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.depth.align import align_disparity, align_scale
from lerobot_msdyn.priors.depth.blurred_edges import sharpened
from lerobot_msdyn.priors.depth.depth_anything import predict_depth
from lerobot_msdyn.priors.depth.flying_pixels import clean_recorded_depth, without_flying_pixels
from lerobot_msdyn.priors.depth.multiview import multiview_depth, usable_partners, why_no_partner
from lerobot_msdyn.priors.depth.table_plane import table_plane_depth
from lerobot_msdyn.priors.hub import LocalModel, demand_model, find_model, has_library, learned_origin
from lerobot_msdyn.priors.masks.provide import file_origin
from lerobot_msdyn.priors.request import FILE, Candidate, Request, first_that_works

type Depth = tuple[Float[Tensor, "t h w"], DepthTraits]  # m, 0 = unknown
type Found = tuple[Depth, Origin]

RECORDED = DepthTraits(metric=True, sharp=True, relative_error=0.01)
STEREO = DepthTraits(metric=True, relative_error=0.02)
PLANE = DepthTraits(sharp=True, relative_error=0.10, assumed=True)


def provide_depth(request: Request, instances: UInt8[Tensor, "t h w"]) -> Found:
    """Depth by the provider that `priors.depth` names; `instances` are the masks.

    Raises:
        PriorError: it was asked for by name and cannot be had.
    """
    provider = request.config.depth
    if provider == "auto":
        return first_that_works("depth", _candidates(request, instances))
    if provider.endswith(FILE):
        return _from_file(request, instances, provider)
    if provider in _models(request):
        model = demand_model(_models(request)[provider], "priors.depth", provider)
        return _learned(request, instances, provider, model, "asked for")
    run: dict[str, Callable[[], Found]] = {
        "recorded": lambda: _recorded(request, "asked for"),
        "stereo": lambda: _stereo(request, instances, "asked for"),
        "plane": lambda: _plane(request, instances, "asked for"),
    }
    return run[provider]()


def _models(request: Request) -> dict[str, str]:
    """Provider -> model, the best first."""
    return {
        "depth_anything_metric": request.config.depth_anything_metric_model,
        "depth_anything": request.config.depth_anything_model,
    }


def _candidates(request: Request, instances: UInt8[Tensor, "t h w"]) -> list[Candidate[Depth]]:
    found: list[Candidate[Depth]] = []
    if request.view.depth is not None:
        found.append(Candidate("recorded", "the dataset has it", functools.partial(_recorded, request)))
    missing = "no depth is recorded" if not found else "the recorded depth cannot be used"
    models = {name: find_model(wanted) for name, wanted in _models(request).items() if has_library("transformers")}
    for name, model in models.items():
        if model is not None:
            run = functools.partial(_learned, request, instances, name, model)
            found.append(Candidate(name, f"{missing}; its model is on this machine", run))
    missing += ", no learned model " + ("could be used" if any(models.values()) else "is on this machine")
    if usable_partners(request.view, request.others):
        why = f"{missing}; other calibrated cameras see the scene"
        found.append(Candidate("stereo", why, functools.partial(_stereo, request, instances)))
        missing += ", the other cameras do not help"
    else:
        missing += f", {why_no_partner(request.view, request.others)}"
    found.append(Candidate("plane", missing, functools.partial(_plane, request, instances)))
    return found


def _recorded(request: Request, why: str) -> Found:
    view = request.view
    if view.depth is None:
        raise PriorError("priors.depth is 'recorded', but the dataset has no <camera>_depth feature; use auto or plane")
    depth = clean_recorded_depth(view.depth, *view.depth_range)
    if not bool((depth > 0).any()):
        raise PriorError(
            f"the recorded depth of {request.key or 'the camera'} holds no measurement in any of its "
            f"{len(depth)} frames (all 0 or out of range); use --priors.depth plane"
        )
    return (depth, RECORDED), Origin("recorded", why)


def _plane(request: Request, instances: UInt8[Tensor, "t h w"], why: str) -> Found:
    camera = request.camera
    depth = table_plane_depth(instances, request.view.camera.intrinsics[0], camera.height_m, camera.tilt_deg)
    seen = f"a table seen from {camera.height_m:g} m at {camera.tilt_deg:g} degrees"
    return (depth, PLANE), Origin("plane", f"{seen}; {why}")


def _stereo(request: Request, instances: UInt8[Tensor, "t h w"], why: str) -> Found:
    partners = usable_partners(request.view, request.others)
    if not partners:
        raise PriorError(
            f"priors.depth is 'stereo', but {why_no_partner(request.view, request.others)}; "
            "name two or more cameras of the episode in --camera.calibration and in --cameras"
        )
    views = [request.view, *partners]

    def compute() -> dict[str, np.ndarray]:
        return {"depth": multiview_depth(request.view, partners, instances).numpy().astype(np.float16)}

    settings = {
        "cameras": [[view.camera.intrinsics[0].tolist(), view.camera.world_from_camera[0].tolist()] for view in views],
        "others": [digest_of(view.rgb) for view in partners],
        "masks": digest_of(instances),
    }
    found = request.cache.get("depth", "stereo", settings, compute)
    why = f"with {len(partners)} other camera{'s' if len(partners) > 1 else ''}; {why}"
    return (torch.from_numpy(found["depth"].astype(np.float32)), STEREO), Origin("stereo", why)


def _learned(request: Request, instances: UInt8[Tensor, "t h w"], provider: str, model: LocalModel, why: str) -> Found:
    def compute() -> dict[str, np.ndarray]:
        values, metric = predict_depth(request.view.rgb, model, request.device)
        return {"values": values.numpy().astype(np.float16), "metric": np.array(metric)}

    settings = {"model": model.name, "revision": model.revision}
    found = request.cache.get("depth", provider, settings, compute)
    values = torch.from_numpy(found["values"].astype(np.float32))
    kind = "metric" if bool(found["metric"]) else "affine_disparity"
    if (kind == "metric") != (provider == "depth_anything_metric"):
        raise PriorError(f"priors.depth is {provider!r}, but {model.name} predicts {kind.replace('_', ' ')}")
    depth, true_metres, how = _scaled(request, instances, values, kind, file=False)
    return (_clean(depth), DepthTraits(true_metres)), learned_origin(provider, model, f"{why}; {how}")


def _from_file(request: Request, instances: UInt8[Tensor, "t h w"], pattern: str) -> Found:
    content = request.exchange(pattern)
    if content.depth is None:
        raise PriorError(f"priors.depth: {pattern} has no array `depth`; see docs/priors.md")
    values = torch.from_numpy(content.depth)
    depth, true_metres, how = _scaled(request, instances, values, content.depth_kind, file=True)
    origin = file_origin(content.provenance.get("depth"), pattern)
    why = f"{origin.why}, {content.depth_kind}; {how}"
    return (_clean(depth), DepthTraits(true_metres)), Origin("file", why, origin.model, origin.revision, origin.licence)


def _clean(depth: Float[Tensor, "t h w"]) -> Float[Tensor, "t h w"]:
    """Depth (m) without blurred edges: what is near a surface is put on it, and the rest becomes unknown."""
    return without_flying_pixels(sharpened(depth))


def _scaled(
    request: Request, instances: UInt8[Tensor, "t h w"], values: Float[Tensor, "t h w"], kind: str, *, file: bool
) -> tuple[Float[Tensor, "t h w"], bool, str]:
    """Values of some kind as depth (m), whether the metres are true, and how they were found.

    A file's metric depth is taken at its word. A network's is that of an unknown focal length: a reference in true
    metres corrects its scale where there is one.
    """
    if kind == "metric" and file:
        return torch.where(torch.isfinite(values), values, 0.0).clamp(min=0), True, "in metres"
    (reference, traits), origin = _reference(request, instances)
    true_metres = traits.metric
    usable = None if traits.measured else instances == 0
    if kind == "affine_disparity":
        return align_disparity(values, reference, usable), true_metres, f"scaled and shifted to {origin.provider}"
    if kind == "metric" and not true_metres:
        return values, False, "in the network's own metres"
    return align_scale(values, reference, usable), true_metres, f"scaled to {origin.provider}"


def _reference(request: Request, instances: UInt8[Tensor, "t h w"]) -> Found:
    """The best depth that needs no network: recorded, from several cameras, or the table plane."""
    candidates = [
        candidate
        for candidate in _candidates(request, instances)
        if candidate.provider in ("recorded", "stereo", "plane")
    ]
    return first_that_works("depth to align to", candidates)
