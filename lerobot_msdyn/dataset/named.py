"""A dataset by its name: in LeRobot's home, else on the hub. Without LeRobot, whose import takes seconds."""

import difflib
import os
from pathlib import Path

from huggingface_hub import constants

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.core.files import check_root

HUB_TIMEOUT_S = 10
INFO_PLACES = "*/*/meta/info.json"  # of the datasets in LeRobot's home


def lerobot_home() -> Path:
    """Where LeRobot keeps datasets: `lerobot.utils.constants.HF_LEROBOT_HOME`."""
    return Path(os.environ.get("HF_LEROBOT_HOME", Path(constants.HF_HOME) / "lerobot")).expanduser()


def output_folder(place: Path) -> Path:
    """The folder of an output: the place itself or, where there is none, that of the dataset of this name."""
    named = lerobot_home() / place
    return named if named.is_dir() and not place.is_dir() else place


def check_there(repo_id: str, root: Path | None) -> None:
    """Whether there is a dataset in a folder or, without one, of a name: before slow imports.

    Raises:
        DatasetError: there is none.
    """
    if root is None:
        check_named(repo_id)
    else:
        check_root(root)


def check_named(repo_id: str) -> None:
    """Whether there is a dataset of this name, here or on the hub, which is asked once.

    LeRobot itself asks again and again, for minutes where the hub cannot be reached.

    Raises:
        DatasetError: there is none.
    """
    home = lerobot_home()
    downloaded = home / "hub" / f"datasets--{repo_id.replace('/', '--')}"
    if (home / repo_id / "meta" / "info.json").exists() or downloaded.exists():
        return
    from huggingface_hub import HfApi  # only now: its clients take as long to import as all of the help

    try:
        HfApi().dataset_info(repo_id, timeout=HUB_TIMEOUT_S)
    except Exception as error:  # several libraries take part, each with errors of its own
        raise no_dataset(repo_id, error) from error


def no_dataset(repo_id: str, error: Exception) -> DatasetError:
    """What to say where there is no dataset of this name."""
    home = lerobot_home()
    names = [path.parents[1].relative_to(home).as_posix() for path in home.glob(INFO_PLACES)]
    near = difflib.get_close_matches(repo_id, names, n=1)
    hint = f"did you mean {near[0]!r}? Else" if near else "if it lies elsewhere,"
    return DatasetError(
        f"no dataset {repo_id!r}: not in {home / repo_id}, and the hub does not have it or cannot be reached "
        f"({type(error).__name__}); {hint} give its folder with --root"
    )
