"""A converted copy of a dataset of version v2.1; the source stays as it is."""

import contextlib
import json
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path

from lerobot.datasets.utils import DEFAULT_VIDEO_FILE_SIZE_IN_MB
from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset

from lerobot_msdyn.core.errors import DatasetError, first_line
from lerobot_msdyn.core.files import temporary_files_in, write_whole, writing
from lerobot_msdyn.dataset.checks import check_features, read_json, regular_file
from lerobot_msdyn.dataset.staging import CONVERTED

logger = logging.getLogger(__name__)

LEGACY_VERSION = "v2.1"
ONE_EACH_MB = 1e-9
CONVERTING = Path("converting") / "dataset"  # in the work folder


def converted_copy(repo_id: str, root: Path, folder: Path) -> Path:
    """Copy a dataset into a work folder and convert it there with LeRobot's script; done once.

    Raises:
        DatasetError: it is not of version v2.1, names files outside of itself, or LeRobot cannot convert it.
        OutputError: the work folder cannot be written.
    """
    done = folder / CONVERTED
    if done.exists():
        return done
    info = read_json(root, "meta/info.json")
    version = info.get("codebase_version")
    if version != LEGACY_VERSION:
        raise DatasetError(f"{root} is a LeRobot dataset of version {version}; --convert takes {LEGACY_VERSION} only")
    check_features(info.get("features"), root / "meta" / "info.json")
    logger.info("converting a copy of %s from %s", root, LEGACY_VERSION)
    copy = folder / CONVERTING
    with writing(folder), temporary_files_in(folder):
        shutil.rmtree(copy.parent, ignore_errors=True)
        for path in sorted(root.rglob("*")):
            if not path.is_dir():
                target = copy / path.relative_to(root)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(regular_file(root, path.relative_to(root)), target)
    try:
        with temporary_files_in(folder), _lerobot_quiet():
            # A file per episode: the script puts videos together whatever their codecs, and by the lengths they claim.
            convert_dataset(repo_id, root=copy, push_to_hub=False, video_file_size_in_mb=ONE_EACH_MB)
    except Exception as error:  # several libraries read the files, each with errors of its own
        reason = named_as_given(first_line(error), folder, root)
        raise DatasetError(f"{root} cannot be converted by LeRobot's script ({reason})") from error
    new = read_json(copy, "meta/info.json")
    new |= {"fps": info.get("fps"), "video_files_size_in_mb": DEFAULT_VIDEO_FILE_SIZE_IN_MB}  # it rounds fps
    with writing(folder):
        write_whole(copy / "meta" / "info.json", json.dumps(new, indent=4).encode())
    copy.rename(done)
    shutil.rmtree(copy.parent)
    return done


def named_as_given(message: str, folder: Path, root: Path) -> str:
    """A message in which the copy in a work folder, which its reader will not find, is called by the source's name.

    Args:
        message: any text.
        folder: the work folder.
        root: the source.
    """
    for path, name in ((folder / CONVERTING, f"{root}"), (folder / CONVERTED, f"{root} (converted)")):
        message = message.replace(str(path), name)
    return message


@contextlib.contextmanager
def _lerobot_quiet() -> Iterator[None]:
    """Without LeRobot's line per file, which goes to the root logger, and per field that only the old version had."""

    def worse(record: logging.LogRecord) -> bool:
        return record.levelno > logging.WARNING

    loggers = (logging.root, logging.getLogger("lerobot.datasets.utils"))
    for each in loggers:
        each.addFilter(worse)
    try:
        yield
    finally:
        for each in loggers:
            each.removeFilter(worse)
