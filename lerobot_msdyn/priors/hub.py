"""Learned models that are on this machine already, with their licences. Nothing is ever downloaded from here."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import torch
from huggingface_hub import constants, try_to_load_from_cache

from lerobot_msdyn.core.errors import PriorError
from lerobot_msdyn.core.observations import Origin

UNKNOWN_LICENCE = "unknown: read its model card"
NON_COMMERCIAL = "CC-BY-NC-4.0"
# As their model cards state them; no default of this package is restricted to non-commercial use.
LICENCES = {
    "facebook/sam2.1-hiera-tiny": "Apache-2.0",
    "facebook/sam2.1-hiera-small": "Apache-2.0",
    "facebook/sam2.1-hiera-base-plus": "Apache-2.0",
    "facebook/sam2.1-hiera-large": "Apache-2.0",
    "yonigozlan/EdgeTAM-hf": "Apache-2.0",
    "depth-anything/Depth-Anything-V2-Small-hf": "Apache-2.0",
    "depth-anything/Depth-Anything-V2-Base-hf": NON_COMMERCIAL,
    "depth-anything/Depth-Anything-V2-Large-hf": NON_COMMERCIAL,
    "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf": "Apache-2.0",
    "depth-anything/Depth-Anything-V2-Metric-Indoor-Base-hf": NON_COMMERCIAL,
    "depth-anything/Depth-Anything-V2-Metric-Indoor-Large-hf": NON_COMMERCIAL,
}
# transformers builds the default configuration of EdgeTAM when it loads one, and reads this model's for it.
COMPANIONS = {"edgetam": "timm/repvit_m1.dist_in1k"}


@dataclass(frozen=True)
class LocalModel:
    """A model that can be loaded without a network."""

    name: str  # id on the hub, or the folder that was given
    folder: Path
    revision: str  # commit on the hub; "local" for a folder
    licence: str


def learned_origin(provider: str, model: LocalModel, why: str) -> Origin:
    """The origin of what a learned model predicted."""
    return Origin(provider, why, model.name, model.revision, model.licence)


def find_model(name: str) -> LocalModel | None:
    """The model of an id in the local Hugging Face cache, or in a folder of that name; None if it is in neither."""
    licence = LICENCES.get(name, UNKNOWN_LICENCE)
    folder = Path(name).expanduser()
    if _is_complete(folder):
        return LocalModel(name, folder, "local", licence)
    if name.count("/") != 1 or folder.is_absolute():
        return None
    config = try_to_load_from_cache(name, "config.json", cache_dir=constants.HF_HUB_CACHE)
    if not isinstance(config, str) or not _is_complete(Path(config).parent):
        return None
    return LocalModel(name, Path(config).parent, Path(config).parent.name, licence)


def has_companion(provider: str) -> bool:
    """Whether the configuration that a provider needs besides its model is in the local cache."""
    name = COMPANIONS.get(provider)
    return name is None or isinstance(
        try_to_load_from_cache(name, "config.json", cache_dir=constants.HF_HUB_CACHE), str
    )


def _is_complete(folder: Path) -> bool:
    return (folder / "config.json").is_file() and any(folder.glob("*.safetensors"))


def demand_model(name: str, field: str, provider: str) -> LocalModel:
    """The model, which was asked for by name.

    Raises:
        PriorError: it, or the library that runs it, is not on this machine.
    """
    demand_library("transformers", "priors", field, provider)
    model = find_model(name)
    if model is None:
        raise PriorError(
            f"{field} is {provider!r}, but the model {name} is not on this machine; fetch it with: hf download {name}"
        )
    if not has_companion(provider):
        companion = COMPANIONS[provider]
        raise PriorError(
            f"{field} is {provider!r}, which needs the configuration of {companion} as well; "
            f"fetch it with: hf download {companion} config.json"
        )
    return model


def demand_library(module: str, extra: str, field: str, provider: str) -> None:
    """Raise a PriorError if an optional library is not installed."""
    if not has_library(module):
        raise PriorError(
            f"{field} is {provider!r}, which needs {module}; install it with: pip install 'lerobot_msdyn[{extra}]'"
        )


def torch_device(name: str) -> str:
    """The device that `auto`, `cpu` or `cuda` stands for.

    Raises:
        PriorError: there is no CUDA device.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise PriorError("device is 'cuda', but no CUDA device is there; use --device auto or cpu")
    return "cuda" if available and name != "cpu" else "cpu"


def has_library(module: str) -> bool:
    """Whether an optional library is installed."""
    try:
        return importlib.util.find_spec(module) is not None
    except ValueError:  # a module without a spec, or None in sys.modules
        return False
