"""DyCheck's iPhone sequences by one protocol and several recipes, beside published rows of the same protocol.

    python benchmarks/dycheck.py --data FOLDER --protocol som --out OUT --recipes paper [-- --fit.steps 75000 ...]
    python benchmarks/dycheck.py --data FOLDER --protocol som --out OUT --recipes paper balanced --table

The first fits and scores what FOLDER has, by one recipe, and prints its rows; the second prints those of all that is
scored, and runs nothing. FOLDER holds any sequences; papers report apple, block, paper-windmill, spin and teddy. What
stands behind `--` goes to every `python -m lerobot_msdyn.evaluate dycheck`. A sequence whose
OUT/<recipe>/<sequence>/scores.json is there is not run again. Rows of the two protocols are never shown together: they
differ in pictures, cameras and masks.
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

Means = dict[str, dict[str, float]]  # what is scored (the fit, the recorded picture, ...) -> score -> value


def main(arguments: list[str]) -> int:
    """Runs what is not there yet and prints the table."""
    split = arguments.index("--") if "--" in arguments else len(arguments)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the sequences")
    parser.add_argument("--out", type=Path, required=True, help="where pictures and scores go")
    parser.add_argument("--protocol", choices=sorted(PUBLISHED), default="som")
    parser.add_argument("--recipes", nargs="+", default=["paper"], help="names or files")
    parser.add_argument("--sequences", nargs="+", help="default: those of --data with pictures that validate")
    parser.add_argument("--table", action="store_true", help="run nothing; show what is scored")
    a = parser.parse_args(arguments[:split])
    found: dict[str, dict[str, Means]] = {}
    for recipe in a.recipes:
        name = Path(recipe).stem
        flags = ["--recipe", recipe, "--protocol", a.protocol, *arguments[split + 1 :]]
        for sequence in a.sequences or sequences_in(a.data):
            out = a.out / name / sequence
            if not (a.table or (out / "scores.json").is_file()):
                evaluate.run(["dycheck", "--root", str(a.data / sequence), "--out", str(out), *flags])
            if (out / "scores.json").is_file():
                found.setdefault(name, {})[sequence] = scores_of(out, a.protocol)
    if not found:
        raise ConfigError(f"{a.out}: has no scores of {', '.join(a.recipes)}; run without --table first")
    print(table(found, a.protocol))
    return 0


def sequences_in(data: Path) -> list[str]:
    """Names of the sequences that have pictures of cameras other than 0.

    Raises:
        ConfigError: there is none.
    """
    names = sorted({path.parents[2].name for path in data.glob("*/rgb/[12]x/[1-9]*_*.png")})
    if not names:
        raise ConfigError(f"{data}: holds no sequence with pictures that validate (<sequence>/rgb/2x/1_00000.png)")
    return names


def scores_of(out: Path, protocol: str) -> Means:
    """Mean scores of one sequence by an earlier run.

    Raises:
        ConfigError: that was of the other protocol.
    """
    path = out / "scores.json"
    content = json.loads(path.read_text())
    if content["protocol"] != protocol:
        raise ConfigError(f"{path} is of protocol {content['protocol']}, not {protocol}; choose another --out")
    return content["mean"]


def table(found: dict[str, dict[str, Means]], protocol: str) -> str:
    """A line per recipe and sequence, and their mean; published means beside it if that is of the five of papers."""
    rows: dict[str, dict[str, dict[str, float]]] = {}
    for recipe, of_sequences in found.items():
        for sequence, means in of_sequences.items():
            for kind, scores in means.items():
                rows.setdefault(kind.replace("this fit", recipe), {})[sequence] = scores
    lines = [f"| protocol {protocol} | mPSNR | mSSIM | mLPIPS |", "|---|---|---|---|"]
    for label, scored in rows.items():
        values = {name: [scores.get(score) for score in SCORES] for name, scores in scored.items()}
        lines += [_line(f"{label}, {name}", row) for name, row in values.items()]
        five = set(SEQUENCES) <= set(values)
        columns = list(zip(*(values[name] for name in (SEQUENCES if five else values)), strict=True))
        mean = [None if None in column else float(np.mean(column)) for column in columns]
        lines.append(_line(f"{label}, mean of {'the five' if five else len(values)}", mean))
    published = PUBLISHED[protocol] if all(set(SEQUENCES) <= set(each) for each in found.values()) else {}
    return "\n".join([*lines, *(_line(f"published: {name}", row, 2) for name, row in published.items())])


def _line(name: str, row: list[float | None] | tuple[float | None, ...], digits: int = 3) -> str:
    """PSNR with two digits, as published, the others with `digits`."""
    shown = ["-" if value is None else f"{value:.{2 if i == 0 else digits}f}" for i, value in enumerate(row)]
    return f"| {name} | " + " | ".join(shown) + " |"


if __name__ == "__main__":
    run_command(main, sys.argv[1:])
