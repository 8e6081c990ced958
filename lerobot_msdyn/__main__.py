"""All commands by one name: `lerobot-msdyn augment --repo local/ds`, or `python -m lerobot_msdyn augment ...`."""

import difflib
import importlib
import sys

from lerobot_msdyn.core.cli import EXIT_OK, run_command
from lerobot_msdyn.core.errors import ConfigError

COMMANDS = {  # name -> module, purpose
    "augment": ("augment.__main__", "write new episodes of a dataset, seen from displaced cameras"),
    "cluster": ("cluster.__main__", "the same, split into many tasks: one machine, SLURM or Ray"),
    "viewer": ("viewer", "look at an episode, its scene and its new views in Rerun"),
    "priors": ("priors.__main__", "look at the masks, depth and tracks of an episode"),
    "models": ("models", "list, fetch and check the learned models"),
    "calibrate": ("calibrate", "find where the cameras stand, from the robot's joints"),
    "recipes": ("recipes", "list, show and check recipes"),
    "export-ply": ("export_ply", "export frames of a saved scene as .ply files"),
    "split": ("split", "training and evaluation episodes that share no recording"),
    "carry": ("carry", "keep the provenance of datasets that LeRobot's tools merged or cut"),
    "evaluate": ("evaluate.__main__", "score reconstructions on held-out views"),
    "synthetic": ("synthetic.__main__", "make small datasets with ground truth"),
}


def run(arguments: list[str]) -> int:
    """Run the command that the first argument names; returns its exit code."""
    name, *rest = arguments or ["--help"]
    if name in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        lines = [f"  {each:{width}s}  {purpose}\n" for each, (_, purpose) in COMMANDS.items()]
        more = "More about one of them: lerobot-msdyn COMMAND --help"
        sys.stdout.write(f"usage: lerobot-msdyn COMMAND ...\n\n{''.join(lines)}\n{more}\n")
        return EXIT_OK
    known = name.replace("_", "-")
    if known not in COMMANDS:
        near = difflib.get_close_matches(known, COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(COMMANDS)}"
        raise ConfigError(f"no command {name!r}; {hint}")
    command = importlib.import_module(f"lerobot_msdyn.{COMMANDS[known][0]}")
    return int(command.run(rest))


def main() -> None:
    """Entry point."""
    run_command(run)


if __name__ == "__main__":
    main()
