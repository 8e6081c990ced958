"""Which provider of masks is run, and its result."""

import functools

import torch
from jaxtyping import UInt8
from torch import Tensor

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import Origin
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.hub import LocalModel, demand_model, find_model, has_companion, has_library, learned_origin
from lerobot_msdyn.priors.masks.moving import moving_instances, temporal_median
from lerobot_msdyn.priors.masks.sam2 import sam2_masks
from lerobot_msdyn.priors.request import FILE, Candidate, Request, first_that_works

type Masks = UInt8[Tensor, "t h w"]


def provide_masks(request: Request) -> tuple[Masks, Origin]:
    """Instances of every frame, by the provider that `priors.masks` names.

    Raises:
        PriorError: it was asked for by name and cannot be had.
    """
    provider = request.config.masks
    if provider == "auto":
        return first_that_works("masks", list(_candidates(request)))
    if provider == "change":
        return change(request, "asked for")
    if provider.endswith(FILE):
        return _from_file(request, provider)
    model = demand_model(_models(request)[provider], "priors.masks", provider)
    return _learned(request, provider, model, "asked for")


def _models(request: Request) -> dict[str, str]:
    """Provider -> model, the best first."""
    return {"sam2": request.config.sam2_model, "edgetam": request.config.edgetam_model}


def _candidates(request: Request) -> list[Candidate[Masks]]:
    found = {name: find_model(model) for name, model in _models(request).items() if has_companion(name)}
    if not has_library("transformers"):
        found = {}
    learned = [
        Candidate(name, "its model is on this machine", functools.partial(_learned, request, name, model))
        for name, model in found.items()
        if model is not None
    ]
    why = "no learned model could be used" if learned else "no learned model is on this machine"
    return [*learned, Candidate("change", why, functools.partial(change, request))]


def change(request: Request, why: str) -> tuple[Masks, Origin]:
    """Weights-free masks."""
    rgb, elsewhere = request.view.rgb, request.elsewhere

    def compute() -> dict:
        return {"masks": moving_instances(rgb, *temporal_median(rgb, elsewhere), elsewhere).numpy()}

    settings = {} if elsewhere is None else {"elsewhere": digest_of(elsewhere)}
    found = request.cache.get("masks", "change", settings, compute)
    return torch.from_numpy(found["masks"]), Origin("change", why)


def _learned(request: Request, provider: str, model: LocalModel, why: str) -> tuple[Masks, Origin]:
    prompts, _ = change(request, "")
    if not bool(prompts.any()):
        raise PriorError(f"priors.masks: {provider} needs something that moves as a prompt, and nothing was found")

    def compute() -> dict:
        return {"masks": sam2_masks(request.view.rgb, prompts, model, request.device).numpy()}

    settings = {"model": model.name, "revision": model.revision}
    found = request.cache.get("masks", provider, settings, compute)
    return torch.from_numpy(found["masks"]), learned_origin(provider, model, why)


def _from_file(request: Request, pattern: str) -> tuple[Masks, Origin]:
    content = request.exchange(pattern)
    if content.masks is None:
        raise PriorError(f"priors.masks: {pattern} has no array `masks`; see docs/priors.md")
    return torch.from_numpy(content.masks), file_origin(content.provenance.get("masks"), pattern)


def file_origin(entry: object, pattern: str) -> Origin:
    """That of an exchange file, with what the file says about itself."""
    stated = entry if isinstance(entry, dict) else {}
    known = {name: str(stated[name]) for name in ("model", "revision", "licence") if name in stated}
    return Origin("file", f"read from {pattern}", **known)
