"""The kinds of camera change that come with the package: one file each, which registers itself, and nothing else."""
