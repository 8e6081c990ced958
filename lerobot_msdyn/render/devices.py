"""Which device a run fits and renders on."""

import logging
from functools import cache

import torch

from lerobot_msdyn.core.config import Device
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.render.availability import cuda_problem, has_cuda_device

logger = logging.getLogger(__name__)


def chosen_device(name: Device) -> torch.device:
    """The device that `auto`, `cpu` or `cuda` stands for; `auto` says once why it is not a GPU.

    Raises:
        ConfigError: `cuda` was demanded and cannot be used.
    """
    problem = "" if name == "cpu" else cuda_problem()
    if problem and name == "cuda":
        raise ConfigError(f"device is 'cuda', but {problem}; or use --device cpu")
    if problem:
        _say_once(problem)
    return torch.device("cpu" if name == "cpu" or problem else "cuda")


@cache
def _say_once(problem: str) -> None:
    level = logging.WARNING if has_cuda_device() else logging.INFO
    logger.log(level, "fitting and rendering on the CPU: %s", problem)
