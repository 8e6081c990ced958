"""One task in a process of its own; the command of `cluster` and its steps start it, nobody types it.

python -m lerobot_msdyn.cluster.rank JOB_FILE STEP LOGS RANK WORLD_SIZE [--bare]

It ends, with all that it has started, where the process that started it is gone.
"""

import contextlib
import os
import signal
import sys
import threading

from lerobot_msdyn.core.cli import EXIT_OK, run_command


def run(arguments: list[str]) -> int:
    """Work on one task; returns the exit code."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    job_file, step, logs, rank, world_size, *bare = arguments
    from lerobot_msdyn.cluster.steps import JobStep, work

    if bare:
        for _ in work(job_file, step, int(rank), int(world_size)):
            pass
        return EXIT_OK
    from datatrove.executor import LocalPipelineExecutor

    LocalPipelineExecutor(
        [JobStep(job_file, step, logs)],
        tasks=int(world_size),
        workers=1,
        local_tasks=1,
        local_rank_offset=int(rank),
        logging_dir=logs,
    ).run()
    return EXIT_OK


def _end_with_parent() -> None:
    with contextlib.suppress(OSError):
        os.read(sys.stdin.fileno(), 1)  # not by sys.stdin, whose lock a fork would inherit
    os.killpg(0, signal.SIGKILL)


def main() -> None:
    """Entry point."""
    if os.getpgid(0) != os.getpid():
        os.setpgid(0, 0)
    run_command(run)


if __name__ == "__main__":
    main()
