"""Command line: measure a reconstruction on views that it has not seen (docs/evaluate.md).

python -m lerobot_msdyn.evaluate nvs --scene FOLDER --out DIR
python -m lerobot_msdyn.evaluate dycheck --root SEQUENCE --out DIR
python -m lerobot_msdyn.evaluate heldout-camera --repo ID --train-camera A --test-camera B --calibration FILE --out DIR
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from lerobot_msdyn.core.cli import EXIT_OK, parse_config, run_command
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.dataset.named import check_there
from lerobot_msdyn.evaluate.config import DycheckConfig, EvaluateConfig, HeldoutCameraConfig

COMMAND = "python -m lerobot_msdyn.evaluate"


def _nvs(config: EvaluateConfig) -> str:
    from lerobot_msdyn.evaluate.asked import check_nvs

    check_nvs(config)
    from lerobot_msdyn.evaluate.nvs import evaluate_nvs

    return evaluate_nvs(config).text()


def _dycheck(config: DycheckConfig) -> str:
    from lerobot_msdyn.evaluate.asked import check_dycheck

    check_dycheck(config)
    from lerobot_msdyn.evaluate.dycheck.protocol import evaluate_dycheck

    return evaluate_dycheck(config).text()


def _heldout_camera(config: HeldoutCameraConfig) -> str:
    check_there(config.repo_id, config.root)
    from lerobot_msdyn.evaluate.asked import check_heldout

    check_heldout(config)
    from lerobot_msdyn.evaluate.heldout import evaluate_heldout

    return evaluate_heldout(config).text()


@dataclass(frozen=True)
class Evaluation:
    """One kind of evaluation."""

    config: type
    run: Callable[[Any], str]  # config -> what is printed
    needed: dict[str, str]  # flag -> field that must be given
    usage: str
    recipe: str | None = None  # where the command line names none


EVALUATIONS = {
    "nvs": Evaluation(EvaluateConfig, _nvs, {"scene": "scene_folder", "out": "out"}, "--scene FOLDER --out DIR"),
    "dycheck": Evaluation(
        DycheckConfig, _dycheck, {"root": "root", "out": "out"}, "--root SEQUENCE --out DIR", recipe="paper"
    ),
    "heldout-camera": Evaluation(
        HeldoutCameraConfig,
        _heldout_camera,
        {
            "repo": "repo_id",
            "train-camera": "train_camera",
            "test-camera": "test_camera",
            "calibration": "camera.calibration",
            "out": "out",
        },
        "--repo ID --train-camera A --test-camera B --calibration FILE --out DIR",
    ),
}


def run(arguments: list[str]) -> int:
    """Run an evaluation; returns the exit code."""
    name = arguments[0] if arguments else "nothing"
    if name in ("-h", "--help"):
        sys.stdout.write(
            "usage:\n" + "".join(f"  {COMMAND} {each} {kind.usage}\n" for each, kind in EVALUATIONS.items())
        )
        return EXIT_OK
    kind = EVALUATIONS.get(name)
    if kind is None:
        raise ConfigError(f"which evaluation? got {name!r}; expected: {COMMAND} {' | '.join(EVALUATIONS)} (--help)")
    command = f"{COMMAND} {name}"
    config: Any = parse_config(kind.config, arguments[1:], kind.needed, command=command, recipe=kind.recipe)
    empty = kind.config()
    for flag, path in kind.needed.items():
        if _value(config, path) == _value(empty, path):
            raise ConfigError(f"--{flag} is missing; expected: {command} {kind.usage}")
    sys.stdout.write(kind.run(config))
    return EXIT_OK


def _value(config: object, path: str) -> object:
    for name in path.split("."):
        config = getattr(config, name)
    return config


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
