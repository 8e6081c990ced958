"""A reconstruction on disk: its saved scene (scene/store.py) and, beside it, what new views are judged by."""

import hashlib
import json
from dataclasses import fields
from pathlib import Path

from safetensors import SafetensorError, safe_open

from lerobot_msdyn.core.files import DIGEST_BYTES
from lerobot_msdyn.core.serialise import ValueFileError, load_value
from lerobot_msdyn.reconstruction.result import FittedWindow, Reconstruction
from lerobot_msdyn.scene import store
from lerobot_msdyn.scene.store import SceneSource

JUDGED = "judged.safetensors"
_KNOWN = [item.name for item in fields(FittedWindow) if item.name not in ("start", "scene")]


def save_reconstruction(made: Reconstruction, source: SceneSource, root: Path) -> Path:
    """Write it below a folder of scenes, replacing one that is there; returns its own folder.

    Raises:
        OutputError: it cannot be written.
    """
    windows = [{name: getattr(window, name) for name in _KNOWN} for window in made.windows]
    return store.save(made.saved(source), root, {JUDGED: {"stands": made.stands, "windows": windows}})


def fit_digest(folder: Path) -> str:
    """A digest of what is known of a fit (scores, seconds), without its tensors; empty where that cannot be read."""
    try:
        with safe_open(folder / JUDGED, framework="np") as file:
            known = json.dumps(file.metadata(), sort_keys=True)
    except (OSError, SafetensorError):  # said when it is loaded
        return ""
    return hashlib.blake2b(known.encode(), digest_size=DIGEST_BYTES).hexdigest()


def load_reconstruction(folder: Path) -> Reconstruction:
    """Read that of one camera from its own folder.

    Raises:
        MsdynError: a file is absent, damaged or of another schema.
    """
    saved = store.load(folder)
    try:
        judged = load_value(folder / JUDGED, folder)
    except ValueFileError as error:
        raise ValueFileError(f"{error}; make the scene again with `augment --save_scenes true`") from error
    windows = zip(saved.starts, saved.windows, judged["windows"], strict=True)
    return Reconstruction(
        windows=tuple(FittedWindow(start=start, scene=scene, **known) for start, scene, known in windows),
        metric=saved.metric,
        provenance={name: dict(prior) for name, prior in saved.priors.items()},
        camera=saved.camera,
        distance=saved.distance,
        up=saved.up,
        stands=judged["stands"],
    )
