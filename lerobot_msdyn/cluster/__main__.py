"""Command line: the job of `augment` in many tasks, on one machine, under SLURM or on Ray.

python -m lerobot_msdyn.cluster --repo local/ds --executor slurm --tasks 64 --partition cpu
"""

import importlib.util
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_msdyn.cluster.config import ESSENTIALS, ClusterConfig
from lerobot_msdyn.core.cli import EXIT_OK, EXIT_SOME_EPISODES_FAILED, parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.dataset.named import check_there

if TYPE_CHECKING:
    from lerobot_msdyn.cluster.task import Job

logger = logging.getLogger(__name__)

COMMAND = "python -m lerobot_msdyn.cluster"
ALIASES = {"repo": "repo_id"}


def run(arguments: list[str]) -> int:
    """Make a dataset in many tasks, or submit them; returns the exit code."""
    config = parse_config(ClusterConfig, arguments, ALIASES, command=COMMAND, essentials=ESSENTIALS)
    if not config.repo_id:
        raise ConfigError(f"which dataset? {COMMAND} --repo NAME [--root FOLDER] (see --help)")
    if importlib.util.find_spec("datatrove") is None:
        raise ConfigError("cluster needs datatrove; install it with: pip install 'lerobot_msdyn[cluster]'")
    check_there(config.repo_id, config.root)
    from lerobot_msdyn.augment.asked import check_asked

    check_asked(config)
    from lerobot_msdyn.augment.job import finished_before
    from lerobot_msdyn.augment.run_identity import source_folder
    from lerobot_msdyn.cluster.plan import job_of
    from lerobot_msdyn.dataset.staging import FAILED, Staging, work_folder
    from lerobot_msdyn.dataset.video import quiet_encoders
    from lerobot_msdyn.dataset.write import check_place

    quiet_encoders()
    job = job_of(config)
    settings, new_root = job.config(), Path(job.new_root)
    if config.restart:
        with Staging(new_root) as staging:
            staging.clear()
    done = finished_before(settings, source_folder(settings), new_root)
    if done is not None and not any(work_folder(new_root).glob(f"episodes/*/{FAILED}")):
        sys.stdout.write("".join(f"{line}\n" for line in done))
        return EXIT_OK
    if done is None:
        check_place(source_folder(settings), new_root)
    return _say_plan(config, job) if config.dry_run else _start(config, job)


def _start(config: ClusterConfig, job: "Job") -> int:
    """Run or submit the tasks that are not done."""
    import fsspec

    from lerobot_msdyn.cluster import executors
    from lerobot_msdyn.cluster.plan import at_once, unfinished_ranks
    from lerobot_msdyn.cluster.stages import BACKGROUND, EPISODES, MERGE, step_errors
    from lerobot_msdyn.cluster.task import RESULT, read_json

    for message in step_errors(executors.logs_of(job, MERGE)).values():
        logger.info("the last time: %s", message)
    job.write()
    files, _ = fsspec.url_to_fs(job.logs)
    if files.exists(f"{job.logs}/{RESULT}"):
        files.rm(f"{job.logs}/{RESULT}")
    executors.forget_completion(job, BACKGROUND, [0])  # it asks whether the source is still the same
    executors.forget_completion(job, MERGE, [0])
    executors.forget_completion(job, EPISODES, unfinished_ranks(job))
    if config.executor == "slurm":
        numbers = executors.run_slurm(job, config)
        sys.stdout.write(
            f"submitted: jobs {', '.join(numbers)}; the last one writes {job.new_root}, or says what is missing\n"
            f"watch: squeue --me; logs: {job.logs}\nafterwards, the same command says how it went, and goes on\n"
        )
        return EXIT_OK
    if config.executor == "ray":
        executors.run_ray(job, config)
    else:
        executors.run_local(job, at_once(config))
    if not files.exists(f"{job.logs}/{RESULT}"):
        sys.stdout.write(f"{job.new_root} has all that can be made\n")
        return EXIT_SOME_EPISODES_FAILED
    result = read_json(f"{job.logs}/{RESULT}")
    sys.stdout.write(result["text"] + "".join(f"{line}\n" for line in result["left_out"]))
    return EXIT_SOME_EPISODES_FAILED if result["left_out"] else EXIT_OK


def _say_plan(config: ClusterConfig, job: "Job") -> int:
    """What would be done: what each task costs, and the file for SLURM."""
    from lerobot_msdyn.augment.job import open_job
    from lerobot_msdyn.cluster.plan import cost_table

    settings = job.config()
    opened = open_job(settings, settings.root)
    sys.stdout.write(cost_table(opened, settings, job))
    if config.executor == "slurm":
        from lerobot_msdyn.cluster.executors import sbatch_file

        sys.stdout.write(f"\n{sbatch_file(job, config)}\n")
    sys.stdout.write(f"would be written to {job.new_root}, logs to {job.logs}\n")
    return EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
