"""Every error that this package raises on purpose.

    MsdynError                 something the user can act on: one line, exit code 2
    ├── ConfigError            a recipe or a flag has an unknown key or a bad value
    ├── DatasetError           the source dataset is absent, of an old version, or lacks what was asked for
    │   └── EpisodeError       one episode cannot be read or reconstructed: it is skipped, the others go on
    ├── OutputError            the place to write to is taken or cannot be written
    ├── PriorError             a prior (mask, depth, tracks, camera) was demanded and cannot be had
    ├── RenderError            the rasterizer was given tensors that it cannot render
    └── WorkerError            a process that worked on episodes ended unexpectedly

A message says what, where, got, expected and what to do next.
"""


class MsdynError(Exception):
    """Base of all errors that are reported in one line, without a traceback."""


class ConfigError(MsdynError):
    """A recipe or a flag has an unknown key or a value of the wrong type or range."""


class DatasetError(MsdynError):
    """The source dataset is absent, of an old version, or lacks what was asked for."""


class EpisodeError(DatasetError):
    """One episode cannot be read or reconstructed; the others are not affected."""


class OutputError(MsdynError):
    """The place to write to is taken or cannot be written."""


class PriorError(MsdynError):
    """A prior was demanded and cannot be had."""


class RenderError(MsdynError):
    """The rasterizer was given tensors that it cannot render."""


class WorkerError(MsdynError):
    """A process that worked on episodes ended unexpectedly."""


def one_line(error: object) -> str:
    """A text or an error in one line."""
    return " ".join(str(error).split())


def first_line(error: BaseException) -> str:
    """The kind of an error of a library, and the first line of what it says."""
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__
