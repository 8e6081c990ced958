"""Command line: new viewpoints for every episode of a LeRobot dataset.

python -m lerobot_msdyn.augment --repo local/ds
"""

import logging
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_msdyn.augment.config import ESSENTIALS, AugmentConfig
from lerobot_msdyn.core.cli import EXIT_INTERRUPTED, EXIT_OK, EXIT_SOME_EPISODES_FAILED, parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError, MsdynError
from lerobot_msdyn.dataset.named import check_there

if TYPE_CHECKING:
    from lerobot_msdyn.augment.job import Opened
    from lerobot_msdyn.dataset.staging import Staging

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.augment"
ALIASES = {"repo": "repo_id"}


def run(arguments: list[str]) -> int:
    """Augment a dataset; returns the exit code."""
    config = parse_config(AugmentConfig, arguments, ALIASES, command=COMMAND, essentials=ESSENTIALS)
    if not config.repo_id:
        raise ConfigError(f"which dataset? {COMMAND} --repo NAME [--root FOLDER] (see --help)")
    check_there(config.repo_id, config.root)
    from lerobot_msdyn.augment.asked import check_asked  # needs neither LeRobot nor torch, which take long

    check_asked(config)
    logger.info("opening %s", config.root or config.repo_id)
    # LeRobot and torch take seconds to import: only now, so that --help and bad flags are answered at once.
    from lerobot_msdyn.augment.job import finished_before, open_job, place_of
    from lerobot_msdyn.augment.run_identity import source_folder
    from lerobot_msdyn.dataset.convert import named_as_given
    from lerobot_msdyn.dataset.staging import Staging
    from lerobot_msdyn.dataset.video import quiet_encoders
    from lerobot_msdyn.dataset.write import check_place

    quiet_encoders()
    root = source_folder(config)
    new_repo_id, new_root = place_of(config)
    done = finished_before(config, root, new_root)
    if done is not None:
        sys.stdout.write("".join(f"{line}\n" for line in done))
        return EXIT_OK
    check_place(root, new_root)
    opened = None if config.convert else open_job(config, config.root)
    if opened is not None and config.dry_run:
        return _say_plan(config, opened, new_root)
    staging = Staging(new_root)
    try:
        with staging:
            if opened is None:
                opened = _convert(config, root, staging)
                if config.dry_run:
                    return _say_plan(config, opened, new_root)
            return augment(config, opened, new_repo_id, new_root, staging)
    except MsdynError as error:  # a converted copy is gone when its name is read
        raise type(error)(named_as_given(str(error), staging.folder, root)) from error
    except KeyboardInterrupt:
        kept = staging.kept()
        if kept:
            kept = f"kept in {staging.folder}: {kept}; the same command goes on from there"
        sys.stderr.write(f"interrupted: {kept or 'nothing was finished yet, and nothing is kept'}\n")
        return EXIT_INTERRUPTED


def _convert(config: AugmentConfig, root: Path, staging: "Staging") -> "Opened":
    """The same of a converted copy in the work folder."""
    from lerobot_msdyn.augment.job import describe, open_job
    from lerobot_msdyn.dataset.convert import converted_copy

    staging.agree(describe(config, root), restart=config.restart)
    return open_job(config, converted_copy(config.repo_id, root, staging.folder))


def augment(config: AugmentConfig, opened: "Opened", new_repo_id: str, new_root: Path, staging: "Staging") -> int:
    """Run the job that the command line described and say how it went; returns the exit code."""
    from lerobot_msdyn.augment.job import checked_output, deliver, describe_opened
    from lerobot_msdyn.augment.run import run_local
    from lerobot_msdyn.augment.workers import terse

    start = time.perf_counter()
    if not config.convert:
        staging.agree(describe_opened(config, opened.source), restart=config.restart)
    output = checked_output(config, opened, new_repo_id, new_root, staging)
    with terse(config):
        failures = run_local(opened, config, output)
    done, left_out = deliver(config, opened, output, failures, lambda: time.perf_counter() - start)
    sys.stdout.write(done + "".join(f"{line}\n" for line in left_out))
    return EXIT_SOME_EPISODES_FAILED if left_out else EXIT_OK


def _say_plan(config: AugmentConfig, opened: "Opened", new_root: Path) -> int:
    from lerobot_msdyn.augment.plan import plan

    sys.stdout.write(plan(opened, config, new_root))
    return EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
