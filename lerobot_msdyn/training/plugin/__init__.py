r"""Lets an unmodified `lerobot-train` train on mixed views (docs/training.md).

    LEROBOT_MSDYN_VIEWS="--scenes FOLDER --probability 0.5" \
    lerobot-train --dataset.discover_packages_path=lerobot_msdyn.training.plugin ...

LeRobot imports this package before it reads its own options; the import puts `MixedViews` around the dataset that the
training script makes, and tells it the epoch of the script's sampler. Nothing else of LeRobot is changed.
"""

import functools
import logging
import os
import shlex
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from lerobot.datasets import EpisodeAwareSampler, StreamingLeRobotDataset, factory

from lerobot_msdyn.core.cli import load_recipe, parse_config
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.training.config import MixedViewsConfig
from lerobot_msdyn.training.mixed import MixedViews
from lerobot_msdyn.training.streamed import MixedStream

logger = logging.getLogger(__name__)

VARIABLE = "LEROBOT_MSDYN_VIEWS"
SCRIPTS = ("lerobot.scripts.lerobot_train", "__main__")  # as which module the training script may run
_MAKER, _SAMPLER = "make_train_eval_datasets", "EpisodeAwareSampler"


def config_from_environment() -> MixedViewsConfig:
    """The options in LEROBOT_MSDYN_VIEWS, written as flags.

    Raises:
        ConfigError: the variable is not set, names no scenes, or holds an unknown option or a bad value.
    """
    text = os.environ.get(VARIABLE, "")
    try:
        config = parse_config(MixedViewsConfig, shlex.split(text), {}, command=VARIABLE)
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"{VARIABLE}: {error}") from error
    if not config.scenes.name:
        raise ConfigError(f'{VARIABLE} names no scenes; expected {VARIABLE}="--scenes OUTPUT_FOLDER [--probability P]"')
    return config


def mixed(dataset: Any, config: MixedViewsConfig) -> MixedViews | MixedStream:
    """The dataset of a training script with views mixed in."""
    perturbation = None if config.perturbation is None else load_recipe(config.perturbation).perturbation
    kind = MixedStream if isinstance(dataset, StreamingLeRobotDataset) else MixedViews
    views = kind(dataset, config.scenes, config.probability, perturbation, config.seed, memory_mb=config.memory_mb)
    logger.info(
        "training on mixed views: %g %% of the samples of %d episodes are rendered from %s",
        100 * config.probability,
        len(views.mixer.cache.scenes),
        config.scenes,
    )
    return views


def install(script: ModuleType, config: MixedViewsConfig) -> None:
    """Put mixed views into a training script that was imported already.

    Raises:
        ConfigError: the script is not of a LeRobot that this version knows.
    """
    missing = [name for name in (_MAKER, _SAMPLER) if not hasattr(script, name)]
    if missing:
        raise ConfigError(
            f"{script.__name__} has no {', '.join(missing)}: another LeRobot than 0.6; see docs/training.md, "
            "or wrap the dataset yourself with MixedViews"
        )
    make = getattr(script, _MAKER)
    current: list[MixedViews | MixedStream] = []

    @functools.wraps(make)
    def make_mixed(*arguments: Any, **options: Any) -> tuple[Any, Any]:
        train, held_out = make(*arguments, **options)
        current[:] = [mixed(train, config)]
        return current[0], held_out

    class TellingSampler(EpisodeAwareSampler):
        """LeRobot's sampler, which says when an epoch begins: its worker processes must not repeat their views."""

        def __iter__(self) -> Iterator[int]:
            current[0].set_epoch(self.state_dict()["epoch"])
            return super().__iter__()

    setattr(script, _MAKER, make_mixed)
    setattr(script, _SAMPLER, TellingSampler)


def _install_everywhere() -> None:
    """Find the training script that is running."""
    known = [sys.modules[name] for name in SCRIPTS if name in sys.modules]
    scripts = [module for module in known if getattr(module, _MAKER, None) is factory.make_train_eval_datasets]
    if not scripts:
        raise ConfigError(
            "no training script of LeRobot is running; this package is for "
            "`lerobot-train --dataset.discover_packages_path=lerobot_msdyn.training.plugin`; "
            "elsewhere, wrap the dataset with lerobot_msdyn.training.MixedViews"
        )
    config = config_from_environment()
    for script in scripts:
        install(script, config)


_install_everywhere()
