"""Learned models that are on this machine already. Nothing is ever downloaded from here: `priors.fetch` does that."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import torch
from huggingface_hub import constants, try_to_load_from_cache

from lerobot_msdyn.core.observations import Model
from lerobot_msdyn.priors.models import MODELS, UNKNOWN_LICENCE, how_to_fetch, known_as, licence_of
from lerobot_msdyn.priors.registry import Unusable


@dataclass(frozen=True)
class LocalModel(Model):
    """A model that can be loaded without a network.

    Its name is its id on the hub or the folder that was given, its revision a commit on the hub, "local" of a folder.
    """

    folder: Path = Path()  # of a single file of weights: that file


def find_model(name: str, licence: str = UNKNOWN_LICENCE) -> LocalModel | None:
    """The model of an id in the local Hugging Face cache, or in a folder of that name; None if it is in neither.

    Args:
        name: the id or the folder.
        licence: that of a model which `priors.models` does not list.
    """
    licence = licence_of(name, licence)
    folder = Path(name).expanduser()
    if _is_complete(folder):
        return LocalModel(name, "local", licence, folder)
    if name.count("/") != 1 or folder.is_absolute():
        return None
    config = cached_config(name)
    if config is None or not _is_complete(config.parent):
        return None
    return LocalModel(name, config.parent.name, licence, config.parent)


def local_model(name: str, licence: str = UNKNOWN_LICENCE, *, companion: str = "") -> LocalModel:
    """The same, which must be there.

    Args:
        name: the id or the folder.
        licence: that of a model which `priors.models` does not list.
        companion: id of a model whose configuration transformers reads as it loads this one.

    Raises:
        Unusable: it, or the library that runs it, is not on this machine.
    """
    demand_library("transformers", "priors", f"the model {name}")
    model = find_model(name, licence)
    if model is None:
        raise Unusable(f"the model {name} is not on this machine", f"fetch it with: {how_to_fetch(name)}")
    if companion and cached_config(companion) is None:
        raise Unusable(
            f"the model {name} needs the configuration of {companion} as well",
            f"fetch it with: {how_to_fetch(name) if known_as(name) else f'hf download {companion} config.json'}",
        )
    return model


def demand_library(module: str, extra: str, user: str) -> None:
    """Raise `Unusable` if an optional library is not installed which `user` needs."""
    if not has_library(module):
        raise Unusable(f"{user} needs {module}", f"install it with: pip install 'lerobot_msdyn[{extra}]'")


def has_library(module: str) -> bool:
    """Whether an optional library is installed."""
    try:
        return importlib.util.find_spec(module) is not None
    except ValueError:  # a module without a spec, or None in sys.modules
        return False


def _is_complete(folder: Path) -> bool:
    return (folder / "config.json").is_file() and any(folder.glob("*.safetensors"))


def cached_config(name: str) -> Path | None:
    """The configuration of a model in the local Hugging Face cache: of the revision that is meant, else of any."""
    known = known_as(name)
    revisions = [MODELS[known].revision] if known and MODELS[known].revision else []
    for revision in [*revisions, "main"]:
        path = try_to_load_from_cache(name, "config.json", cache_dir=constants.HF_HUB_CACHE, revision=revision)
        if isinstance(path, str):
            return Path(path)
    return None


def checkpoint(file: str) -> Path:
    """Where torch keeps a single file of weights."""
    return Path(torch.hub.get_dir()) / "checkpoints" / file
