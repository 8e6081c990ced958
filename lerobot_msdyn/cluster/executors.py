"""Where tasks run: datatrove's executors for one machine, SLURM and Ray, each with the three steps."""

import contextlib
import importlib.util
import logging
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import fsspec
from datatrove.executor import LocalPipelineExecutor, RayPipelineExecutor, SlurmPipelineExecutor
from datatrove.executor.base import PipelineExecutor

from lerobot_msdyn.cluster.config import ClusterConfig
from lerobot_msdyn.cluster.stages import BACKGROUND, EPISODES, MERGE, step_errors
from lerobot_msdyn.cluster.steps import MODULE, JobStep, killed
from lerobot_msdyn.cluster.task import Job
from lerobot_msdyn.core.errors import ConfigError, OutputError, WorkerError, one_line

logger = logging.getLogger(__name__)

COMPLETIONS = "completions"  # datatrove's folder of empty files, named by rank
CONSOLE = "console"  # of what tasks of this machine print
POLL_S = 0.2
NOTHING_TO_DO = -1  # instead of a number of a job
SLURM_FAULTS = (FileNotFoundError, subprocess.CalledProcessError)


def logs_of(job: Job, step: str) -> str:
    """Datatrove's folder of a step."""
    return f"{job.logs}/{step}_{job.tasks}" if step == EPISODES else f"{job.logs}/{step}"


def tasks_of(job: Job, step: str) -> int:
    """How many tasks a step has."""
    return job.tasks if step == EPISODES else 1


def forget_completion(job: Job, step: str, ranks: Sequence[int]) -> None:
    """Let tasks run again that datatrove would skip."""
    files, root = fsspec.url_to_fs(logs_of(job, step))
    for rank in ranks:
        with contextlib.suppress(FileNotFoundError):
            files.rm_file(f"{root}/{COMPLETIONS}/{rank:05d}")


def run_local(job: Job, at_once: int) -> None:
    """All steps on this machine, each task in a process of its own.

    Datatrove's pool is not used: it waits for ever for a worker that is killed.

    Raises:
        WorkerError: a task was killed or ended with an error.
    """
    for step in (BACKGROUND, EPISODES, MERGE):
        executor = LocalPipelineExecutor([], tasks_of(job, step), logging_dir=logs_of(job, step))
        ranks = executor.get_incomplete_ranks()
        codes = _processes(job, step, ranks, at_once)
        _demand(job, step, {rank: killed(-code) for rank, code in codes.items() if code < 0}, executor)


def _processes(job: Job, step: str, ranks: Sequence[int], at_once: int) -> dict[int, int]:
    """Run tasks in processes; returns their exit codes."""
    waiting, codes = list(ranks), dict[int, int]()
    with contextlib.ExitStack() as stack:
        running: dict[int, subprocess.Popen] = {}
        stack.callback(_end_all, running)
        while waiting or running:
            while waiting and len(running) < at_once:
                rank = waiting.pop(0)
                running[rank] = _process(job, step, rank)
            time.sleep(POLL_S)
            for rank, process in list(running.items()):
                code = process.poll()
                if code is not None:
                    _end(running.pop(rank))
                    codes[rank] = code
                    logger.info("%s: task %d is %s (%d of %d)", step, rank, _how(code), len(codes), len(ranks))
    return codes


def _how(code: int) -> str:
    return "done" if code == 0 else f"killed ({signal.Signals(-code).name})" if code < 0 else "not done"


def _process(job: Job, step: str, rank: int) -> subprocess.Popen:
    folder = Path(logs_of(job, step)) / CONSOLE if "://" not in job.logs else Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", MODULE, job.file, step, logs_of(job, step), str(rank), str(tasks_of(job, step))]
    environment = os.environ | {"OMP_NUM_THREADS": str(job.threads)}
    with (folder / f"{rank:05d}.log").open("wb") as stream:
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )


def _end_all(running: Mapping[int, subprocess.Popen]) -> None:
    for process in running.values():
        _end(process)


def _end(process: subprocess.Popen) -> None:
    """End a task with all that it has started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert process.stdin is not None
    process.stdin.close()


def run_ray(job: Job, config: ClusterConfig) -> None:
    """All steps on a Ray cluster.

    Raises:
        ConfigError: Ray is not installed.
        WorkerError: a task ended with an error.
    """
    if importlib.util.find_spec("ray") is None:
        raise ConfigError("executor is 'ray', which is not installed; install it with: pip install ray")
    import ray

    address = config.ray_address or os.environ.get("RAY_ADDRESS") or None
    if not ray.is_initialized():
        ray.init(address=address, log_to_driver=False, **({} if address else {"include_dashboard": False}))
    try:
        for step in (BACKGROUND, EPISODES, MERGE):
            executor = RayPipelineExecutor(
                [JobStep(job.file, step, logs_of(job, step), apart=True)],
                tasks=tasks_of(job, step),
                workers=config.at_once or -1,
                logging_dir=logs_of(job, step),
                cpus_per_task=config.cpus_per_task,
                mem_per_cpu_gb=config.mem_per_cpu_gb,
                gpus_per_task=config.gpus,
            )
            if executor.get_incomplete_ranks():
                executor.run()
            _demand(job, step, {}, executor)
    finally:
        ray.shutdown()


def _demand(job: Job, step: str, killed_tasks: dict[int, str], executor: PipelineExecutor) -> None:
    """Whether a step is done.

    Raises:
        WorkerError: it is not, and why.
    """
    lacking = executor.get_incomplete_ranks()
    if not lacking:
        return
    errors = step_errors(logs_of(job, step)) | killed_tasks
    known = [(rank, errors[rank]) for rank in lacking if rank in errors] or [(lacking[0], "its log says why")]
    rank, first = known[0]
    which = (
        "" if tasks_of(job, step) == 1 else f"{len(lacking)} of {tasks_of(job, step)} tasks are not done; task {rank}: "
    )
    raise WorkerError(f"{step}: {which}{first} (logs: {logs_of(job, step)})")


def slurm_executors(job: Job, config: ClusterConfig, slurm_logs: str | None = None) -> dict[str, SlurmPipelineExecutor]:
    """One executor per step, each after the one before; the last one also where tasks failed, to say what lacks."""
    executors: dict[str, SlurmPipelineExecutor] = {}
    before = None
    for step in (BACKGROUND, EPISODES, MERGE):
        options = {"kill-on-invalid-dep": "yes", "chdir": job.folder}
        options |= {name.strip(): value.strip() for name, _, value in (item.partition("=") for item in config.sbatch)}
        before = executors[step] = SlurmPipelineExecutor(
            [JobStep(job.file, step, logs_of(job, step))],
            tasks=tasks_of(job, step),
            time=config.time,
            partition=config.partition,
            cpus_per_task=config.cpus_per_task,
            mem_per_cpu_gb=config.mem_per_cpu_gb,
            gpus_per_task=config.gpus,
            workers=config.at_once or -1,
            job_name=f"{Path(job.new_root).name}-{step}",
            qos=config.qos,
            env_command=config.env_command or f"export PATH={shlex.quote(str(Path(sys.executable).parent))}:$PATH",
            sbatch_args=options,
            srun_args={"cpus-per-task": config.cpus_per_task},  # which srun does not take from sbatch any more
            depends=before,
            logging_dir=logs_of(job, step),
            slurm_logs_folder=None if slurm_logs is None else f"{slurm_logs}/{step}",
            run_on_dependency_fail=step == MERGE,
        )
    return executors


def run_slurm(job: Job, config: ClusterConfig) -> list[str]:
    """Submit all steps; returns the numbers of their jobs.

    Raises:
        OutputError: SLURM refuses them, or those of an earlier command are not done.
    """
    executors = slurm_executors(job, config)
    names = ",".join(executor.job_name for executor in executors.values())
    try:
        queue = ["squeue", "--noheader", "--format=%A", f"--name={names}", "--me"]
        queued = sorted(set(subprocess.run(queue, capture_output=True, text=True, check=True).stdout.split()))
        if queued:
            raise OutputError(
                f"jobs {', '.join(queued)} of an earlier command for {job.new_root} are still queued or running; wait "
                f"for them (squeue --me), or end them first: scancel {' '.join(queued)}"
            )
        for step in (BACKGROUND, EPISODES):
            executors[step].launch_job()
        if executors[EPISODES].job_id == NOTHING_TO_DO:
            executors[MERGE].depends = executors[BACKGROUND]
        executors[MERGE].launch_job()
    except SLURM_FAULTS as error:
        said = getattr(error, "stderr", None) or error
        raise OutputError(f"SLURM does not take the job: {one_line(said)}") from error
    return [str(executor.job_id) for executor in executors.values() if executor.job_id != NOTHING_TO_DO]


def sbatch_file(job: Job, config: ClusterConfig) -> str:
    """What would be given to sbatch for the episodes."""
    with _without_folders() as slurm_logs:
        executor = slurm_executors(job, config, slurm_logs)[EPISODES]
        arguments = executor.get_sbatch_args(min(job.tasks, executor.max_array_size))
        launch = f"launch_pickled_pipeline {executor.logging_dir.resolve_paths('executor.pik')}"
        run = f"srun --cpus-per-task={config.cpus_per_task} -l -n 1 {launch}"
        text: str = executor.get_launch_file_contents(arguments, run)
    return text.replace(f"{slurm_logs}/{EPISODES}", f"{logs_of(job, EPISODES)}/slurm_logs")


@contextlib.contextmanager
def _without_folders() -> Iterator[str]:
    """A place for folders that datatrove makes as it is asked."""
    folder = tempfile.mkdtemp()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
