"""New camera viewpoints for LeRobot datasets; the public names, each imported when it is first used.

Importing this package changes no setting of the process. For speed on a busy machine, set OMP_WAIT_POLICY=PASSIVE
before torch is imported, as the package's commands do (docs/render.md).
"""

import importlib
from typing import Any

_HOMES = {
    "CameraTrack": "core.cameras",
    "DynamicScene": "scene.dynamic",
    "Episode": "dataset.read",
    "Gaussians": "scene.gaussians",
    "MixedViews": "training",
    "MsdynError": "core.errors",
    "OutputDataset": "dataset.write",
    "Priors": "core.observations",
    "Recipe": "core.config",
    "augment_episode": "augment.episode",
    "estimate_priors": "priors",
    "fit": "reconstruction.fit",
    "initialise": "reconstruction.initialise",
    "load_recipe": "core.cli",
    "load_scene": "scene.store",
    "open_source": "dataset.read",
    "rasterize": "render",
    "read_episode": "dataset.read",
    "reconstruct": "reconstruction.reconstruct",
    "render_frames": "scene.rendering",
    "save_scene": "scene.store",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
