"""Known models brought to this machine, and checked: the one place that downloads anything, and only when asked to."""

import hashlib
import os
from pathlib import Path

import torch
from huggingface_hub import hf_hub_download, snapshot_download

from lerobot_msdyn.core.errors import PriorError, first_line
from lerobot_msdyn.core.files import BLOCK_BYTES
from lerobot_msdyn.priors.hub import cached_config, checkpoint, find_model
from lerobot_msdyn.priors.models import MODELS, KnownModel

WEIGHTS = "model.safetensors"
_NEEDED = ("*.json", "*.safetensors")  # of a repository: no weights in other forms
_OFFLINE = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")


def fetch(name: str) -> Path:
    """The folder or file of a known model, which is downloaded unless it is there, and checked.

    Raises:
        PriorError: it cannot be downloaded, or is not what it should be.
    """
    model = MODELS[name]
    if place_of(model) is None:
        _download(name, model)
    problem = wrong_with(name)
    if problem:
        raise PriorError(problem)
    place = place_of(model)
    if place is None:
        raise PriorError(f"{name} was downloaded and is not complete: {model.place} has no {WEIGHTS} of this revision")
    return place


def place_of(model: KnownModel) -> Path | None:
    """Where a known model lies on this machine; None if it is not there."""
    if model.is_file:
        path = checkpoint(model.file)
        return path if path.is_file() else None
    found = find_model(model.place)
    if found is None or (model.companion and cached_config(model.companion) is None):
        return None
    return found.folder


def wrong_with(name: str) -> str:
    """What is wrong with a known model on this machine, in a line; empty if nothing is, or it is not there."""
    model = MODELS[name]
    place = place_of(model)
    if place is None or not model.sha256:
        return ""
    if model.revision and place.name != model.revision:
        return ""  # another revision, which the user has fetched
    weights = place if model.is_file else place / WEIGHTS
    digest = _sha256(weights)
    if digest.startswith(model.sha256):
        return ""
    return f"{name}: {weights} is damaged or of another model (sha256 {digest[:8]}, not {model.sha256[:8]}): remove it"


def offline() -> str:
    """The variable of the environment by which nothing is to be downloaded; empty if there is none."""
    set_to = {variable: os.environ.get(variable, "").lower() for variable in _OFFLINE}
    return next((variable for variable, value in set_to.items() if value in ("1", "true", "yes", "on")), "")


def _download(name: str, model: KnownModel) -> None:
    if offline():
        raise PriorError(f"{name} is not on this machine, and nothing is downloaded while {offline()} is set")
    try:
        if model.is_file:
            path = checkpoint(model.file)
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(model.place, str(path), hash_prefix=model.sha256, progress=False)
            return
        snapshot_download(model.place, revision=model.revision or None, allow_patterns=list(_NEEDED))
        if model.companion:
            hf_hub_download(model.companion, "config.json")
    except Exception as error:  # several libraries take part, each with errors of its own
        raise PriorError(
            f"{name} cannot be downloaded from {model.place} ({first_line(error)}); is there a network? A copy from "
            "another machine serves as well"
        ) from error


def _sha256(path: Path) -> str:
    total = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            total.update(block)
    return total.hexdigest()
