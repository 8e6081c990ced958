"""The five iPhone sequences that are scored in papers, by one protocol, beside published rows of the same protocol.

    python benchmarks/dycheck.py --data FOLDER --protocol som --out outputs/dycheck [-- --fit.steps 75000 ...]

FOLDER holds apple, block, paper-windmill, spin and teddy. What stands behind `--` goes to every
`python -m lerobot_msdyn.evaluate dycheck`. A sequence whose OUT/<name>/scores.json is there is not run again.
Rows of the two protocols are never shown together: they differ in pictures, cameras and masks.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from lerobot_msdyn.core.cli import run_command
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.evaluate import __main__ as evaluate

SEQUENCES = ("apple", "block", "paper-windmill", "spin", "teddy")
SCORES = ("mpsnr", "mssim", "mlpips")
# Means over the five sequences; None: not published for these five.
PUBLISHED: dict[str, dict[str, tuple[float | None, ...]]] = {
    "som": {
        "the paper": (17.07, 0.66, 0.38),
        "the best today": (17.98, 0.70, 0.40),
        "Shape of Motion (the paper's table)": (16.68, None, None),
        "Marbles (the paper's table)": (15.95, None, None),
        "T-NeRF (the paper's table)": (15.09, None, None),
        "HyperNeRF (the paper's table)": (14.28, None, None),
        "Deformable 3DGS (the paper's table)": (10.77, None, None),
    },
    "dycheck": {"T-NeRF (DyCheck)": (17.07, None, None)},
}


def main(arguments: list[str]) -> int:
    """Runs what is not there yet and prints the table."""
    split = arguments.index("--") if "--" in arguments else len(arguments)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the sequences")
    parser.add_argument("--out", type=Path, required=True, help="where pictures and scores go")
    parser.add_argument("--protocol", choices=sorted(PUBLISHED), default="som")
    parser.add_argument("--sequences", nargs="+", default=SEQUENCES, help="others have no published mean")
    a = parser.parse_args(arguments[:split])
    found = {name: scores_of(a.data / name, a.out / name, a.protocol, arguments[split + 1 :]) for name in a.sequences}
    print(table(found, a.protocol))
    return 0


def scores_of(root: Path, out: Path, protocol: str, flags: list[str]) -> dict[str, dict[str, float]]:
    """Mean scores of one sequence, of the fit and of the unchanged picture; from an earlier run if there was one.

    Raises:
        ConfigError: the earlier run was of the other protocol.
    """
    path = out / "scores.json"
    if not path.is_file():
        evaluate.run(["dycheck", "--root", str(root), "--out", str(out), "--protocol", protocol, *flags])
    content = json.loads(path.read_text())
    if content["protocol"] != protocol:
        raise ConfigError(f"{path} is of protocol {content['protocol']}, not {protocol}; choose another --out")
    return content["mean"]


def table(found: dict[str, dict[str, dict[str, float]]], protocol: str) -> str:
    """A line per sequence and published mean; means only over all five."""
    lines = [f"| protocol {protocol} | mPSNR | mSSIM | mLPIPS |", "|---|---|---|---|"]
    for kind in dict.fromkeys(kind for means in found.values() for kind in means):
        rows = [[means[kind].get(score) for score in SCORES] for means in found.values()]
        lines += [_line(f"{kind}, {name}", row) for name, row in zip(found, rows, strict=True)]
        if set(found) == set(SEQUENCES):
            columns = list(zip(*rows, strict=True))
            lines.append(_line(f"{kind}, mean", [None if None in column else np.mean(column) for column in columns]))
    return "\n".join([*lines, *(_line(f"published: {name}", row, 2) for name, row in PUBLISHED[protocol].items())])


def _line(name: str, row: list[float | None] | tuple[float | None, ...], digits: int = 3) -> str:
    """PSNR with two digits, as published, the others with `digits`."""
    shown = ["-" if value is None else f"{value:.{2 if i == 0 else digits}f}" for i, value in enumerate(row)]
    return f"| {name} | " + " | ".join(shown) + " |"


if __name__ == "__main__":
    run_command(main, sys.argv[1:])
