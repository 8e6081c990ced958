"""Where nothing measures depth and scenes stand on an assumed table: what would be better, and how to get it."""

import logging
from collections.abc import Sequence

from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core.config import FIXED, PriorsConfig
from lerobot_msdyn.core.errors import ConfigError, PriorError
from lerobot_msdyn.core.fields import AUTO
from lerobot_msdyn.dataset.read import depth_key_of
from lerobot_msdyn.priors.fetch import fetch, offline
from lerobot_msdyn.priors.hub import demand_library, find_model, has_library
from lerobot_msdyn.priors.models import MODELS, known_as

logger = logging.getLogger(__name__)

LIBRARY, EXTRA = "transformers", "priors"  # that runs the models, and how it is installed


def say_assumed_depth(source: LeRobotDatasetMetadata, cameras: Sequence[str], config: AugmentConfig) -> None:
    """Warn once per run where depth is assumed or rough, or fetch the better model where that is asked for.

    Raises:
        PriorError: it is asked for and cannot be had.
        ConfigError: the settings name a model that this package does not know.
    """
    recorded = all(depth_key_of(source, key) for key in cameras)
    if config.priors.depth != AUTO or recorded or _is_there(config.priors):
        return
    place = config.priors.depth_anything_metric_model
    if config.fetch_models and not offline():
        name = known_as(place)
        if not name:
            raise ConfigError(
                f"fetch_models is true, but {place} is no known model: fetch it with: hf download {place}"
            )
        demand_library(LIBRARY, EXTRA, f"the model {place}")
        try:
            logger.info("depth by %s: %s", place, fetch(name))
        except PriorError as error:
            raise PriorError(f"{error}; without --fetch_models true depth is that of an assumed table plane") from error
        return
    assumed = "the table that the robot stands on, and what vertical edges say of things on it"
    if config.allow_moving and (config.camera.pose_columns or config.camera.poses not in (AUTO, FIXED)):
        assumed = "what the camera's own way tells, which is smooth between corners"
    elif config.camera.calibration is None:
        camera = config.camera
        assumed = (
            f"a table plane seen from {camera.height_m:g} m at {camera.tilt_deg:g} degrees (--camera.height_m, "
            "--camera.tilt_deg)"
        )
    elif len(cameras) > 1:
        assumed = "what several calibrated cameras measure, else on a table plane"
    logger.warning(
        "no recorded depth: scenes are built on %s; keep the changes of view small%s", assumed, _better(place)
    )


def _is_there(priors: PriorsConfig) -> bool:
    """Whether `auto` finds a learned model of depth."""
    models = (priors.depth_anything_metric_model, priors.depth_anything_model)
    return has_library(LIBRARY) and any(find_model(model) is not None for model in models)


def _better(place: str) -> str:
    name = known_as(place)
    if not name:
        return ""
    install = "" if has_library(LIBRARY) else f" after pip install 'lerobot_msdyn[{EXTRA}]'"
    model = MODELS[name]
    how = f"nothing is downloaded while {offline()} is set" if offline() else f"add --fetch_models true{install}"
    return f". Depth would be better with {place} ({model.size_mb} MB, {model.licence}): {how}"
