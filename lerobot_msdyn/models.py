"""Command line: the learned models that can be used, which of them are on this machine, and how to get the others.

python -m lerobot_msdyn.models list | fetch NAME ... | check
"""

import sys

from lerobot_msdyn.core.cli import EXIT_BAD_INPUT, EXIT_OK, run_command
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.priors.models import MODELS

USAGE = """usage: python -m lerobot_msdyn.models list             every model: size, licence, purpose, and if it is here
       python -m lerobot_msdyn.models fetch NAME ...   download models, and check them
       python -m lerobot_msdyn.models check            whether those that are here are what they should be
"""


def run(arguments: list[str]) -> int:
    """Run one of the three; returns the exit code."""
    if arguments[:1] in ([], ["-h"], ["--help"]):
        sys.stdout.write(USAGE)
        return EXIT_OK
    match arguments:
        case ["list" | "ls"]:
            sys.stdout.write("".join(_lines(name) for name in MODELS))
        case ["fetch", _, *_]:
            _fetch(arguments[1:])
        case ["check"]:
            return _check()
        case _:
            raise ConfigError(f"models: got {' '.join(arguments)!r}; expected list, fetch NAME ... or check")
    return EXIT_OK


def _lines(name: str) -> str:
    from lerobot_msdyn.priors.fetch import place_of

    model = MODELS[name]
    here = place_of(model)
    where = f"{model.place} @ {model.revision[:7]}" if model.revision else model.place
    state = "not here" if here is None else f"here: {here}"
    return f"{name:22s} {model.size_mb:4d} MB  {model.licence:13s} {model.purpose}\n    {where}\n    {state}\n"


def _fetch(names: list[str]) -> None:
    unknown = [name for name in names if name not in MODELS]
    if unknown:
        raise ConfigError(f"models: no model {', '.join(unknown)}; expected some of {', '.join(MODELS)}")
    from lerobot_msdyn.priors.fetch import fetch

    for name in names:
        sys.stdout.write(f"{name}: {fetch(name)}\n")


def _check() -> int:
    from lerobot_msdyn.priors.fetch import place_of, wrong_with

    wrong = [problem for name in MODELS if (problem := wrong_with(name))]
    right = [name for name in MODELS if place_of(MODELS[name]) is not None and not wrong_with(name)]
    sys.stdout.write(f"as they should be: {', '.join(right) or 'none is on this machine'}\n")
    sys.stdout.write("".join(f"{problem}\n" for problem in wrong))
    return EXIT_BAD_INPUT if wrong else EXIT_OK


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
