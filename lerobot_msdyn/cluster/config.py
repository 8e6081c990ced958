"""What the command line of `cluster` sets beside the settings of `augment`; no torch here."""

import dataclasses
from dataclasses import dataclass, field

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core.command_help import Essentials
from lerobot_msdyn.core.fields import between

EXECUTORS = ("local", "slurm", "ray")
MEMORY_EACH_GB = 3.0  # for each process that works on an episode, as in `augment.workers`


@dataclass
class ClusterConfig(AugmentConfig):
    """`python -m lerobot_msdyn.cluster`: the job of `augment` in many tasks, which one machine or many work on."""

    # Where tasks run: local (this machine), slurm (sbatch), ray (a cluster that ray.init finds).
    executor: str = "local"
    # Shards of the episodes; each is a task. The output is the same for any number.
    tasks: int = between(8, 1, 100_000)
    # Tasks at the same time; 0: local: as cores and memory allow, else as many as the cluster gives.
    at_once: int = between(0, 0, 100_000)
    # Folder or URL of logs, statistics and completion markers; default: <output>_logs beside the output.
    logs: str | None = None
    # URL of an object store (s3://bucket/prefix) through which nodes without a common file system share their work;
    # default: the hidden folder beside the output, which all nodes see.
    store: str | None = None
    # Cores of a task; it works on as many episodes at once as these and its memory allow (--workers).
    cpus_per_task: int = between(1, 1, 1024)
    # Memory (GB) of a task for each of its cores.
    mem_per_cpu_gb: int = between(4, 1, 1024)
    # GPUs of a task.
    gpus: int = between(0, 0, 64)
    # SLURM: the partition.
    partition: str = ""
    # SLURM: how long a task may take, as sbatch's --time.
    time: str = "24:00:00"
    # SLURM: the quality of service; default: none is named.
    qos: str = ""
    # SLURM: more options of sbatch, e.g. '[account=lab, exclude=node7]'.
    sbatch: list[str] = field(default_factory=list)
    # SLURM: what each task does first; default: put this Python before others on the PATH.
    env_command: str = ""
    # Ray: the cluster's address; default: RAY_ADDRESS, else one of this machine, as long as the command runs.
    ray_address: str = ""

    def problems(self) -> list[str]:
        """One line per rule between or on fields that is broken."""
        lines = []
        if self.executor not in EXECUTORS:
            lines.append(f"executor is {self.executor!r}; expected one of {', '.join(EXECUTORS)}")
        if self.executor == "slurm" and not self.partition:
            lines.append("partition is empty; expected a partition of SLURM (see sinfo): --partition NAME")
        if self.convert:
            lines.append("convert is true; expected a source of version v3.0: convert it once with LeRobot's script")
        wrong = [item for item in self.sbatch if not item.partition("=")[0].strip()]
        if wrong:
            lines.append(f"sbatch has {wrong[0]!r}; expected NAME=VALUE as sbatch's options, without --")
        return lines

    @property
    def processes(self) -> int:
        """Processes of a task that work on episodes at once."""
        if self.workers or self.executor == "local":
            return self.workers or 1
        if self.gpus:
            return 1
        return max(1, min(self.cpus_per_task, int(self.cpus_per_task * self.mem_per_cpu_gb / MEMORY_EACH_GB)))


def job_settings(config: ClusterConfig) -> AugmentConfig:
    """The settings of the job alone."""
    return AugmentConfig(**{item.name: getattr(config, item.name) for item in dataclasses.fields(AugmentConfig)})


ESSENTIALS = Essentials(
    fields=(
        "repo_id",
        "root",
        "new_repo_id",
        "episodes",
        "variants",
        "episodes_share",
        "executor",
        "tasks",
        "partition",
        "time",
        "gpus",
        "dry_run",
    ),
    examples=(
        "--repo local/ds --tasks 8",
        "--repo local/ds --executor slurm --tasks 64 --partition cpu --time 04:00:00 --cpus_per_task 8",
        "--repo local/ds --executor slurm --tasks 64 --partition cpu --dry_run",
    ),
)
