"""The one place that says what `device: auto`, `cpu` and `cuda` mean."""

import logging
from functools import cache

import torch

from lerobot_msdyn.core.config import Device
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.render.availability import cuda_problem, has_cuda_device, no_device_problem

logger = logging.getLogger(__name__)


def chosen_device(name: Device, *, networks: bool = False) -> torch.device:
    """The device for fitting and rendering, or for learned priors.

    `cpu` is the CPU and `cuda` a GPU, or an error. `auto` is a GPU where it can be used, else the CPU: for fitting and
    rendering it must be one that gsplat renders on, and what is missing is said once; networks need torch alone.

    Args:
        name: auto, cpu or cuda.
        networks: whether networks run on it, and nothing is rendered.

    Raises:
        ConfigError: `cuda` was demanded and cannot be used.
    """
    problem = "" if name == "cpu" else no_device_problem() if networks else cuda_problem()
    if problem and name == "cuda":
        raise ConfigError(f"device is 'cuda', but {problem}; or use --device cpu")
    if problem and not networks:
        _say_once(problem)
    return torch.device("cpu" if name == "cpu" or problem else "cuda")


@cache
def _say_once(problem: str) -> None:
    if has_cuda_device():
        logger.warning("fitting and rendering on the CPU: %s", problem)
    else:
        logger.info("fitting and rendering on the CPU (--device cuda says what a GPU would need)")
