"""The job of `augment` as tasks of datatrove, on one machine, under SLURM or on Ray (docs/cluster.md)."""
