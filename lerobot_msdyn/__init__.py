"""New camera viewpoints for LeRobot datasets; the public names, each imported when it is first used."""

import importlib
import os
from typing import Any

# Idle OpenMP threads of torch would otherwise spin on the cores that the rasterizer needs. Read when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_HOMES = {
    "CameraTrack": "cameras",
    "DynamicScene": "scene",
    "Episode": "episode",
    "Gaussians": "scene",
    "MixedViews": "training",
    "MsdynError": "errors",
    "OutputDataset": "write",
    "Priors": "priors",
    "Recipe": "config",
    "augment_episode": "pipeline",
    "estimate_priors": "priors",
    "fit": "fitting",
    "initialise": "initialisation",
    "load_recipe": "cli",
    "load_scene": "scene",
    "open_source": "episode",
    "rasterize": "render",
    "read_episode": "episode",
    "reconstruct": "pipeline",
    "render_frames": "rendering",
    "save_scene": "scene",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
