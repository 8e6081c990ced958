"""The study's result as one table and one plot."""

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np

from .cameras import CAMERAS
from .forms import Form
from .score import BASE, BEST, Outcomes, share, success

MOVED = "all moved"  # the group of all cameras but the recorded one
WIDTH_PX, HEIGHT_PX, LEFT_PX, TOP_PX, KEY_PX = 930, 330, 40, 16, 270
COLOURS = ("#888888", "#c8641b", "#1f7a3d", "#8a3fa0", "#1f5fa8", "#b02a4a", "#9a8a10", "#3aa0a0")


def outcomes(folder: Path, rows: Sequence[str], form: Form) -> Mapping[str, Outcomes]:
    """Group of cameras -> row -> solved [seeds, cameras, tasks]; seeds and groups that are finished only; MOVED last.

    `folder` is that of one policy; it holds <row>/<seed>/<camera>.json.
    """
    groups: dict[str, dict[str, np.ndarray]] = {}
    members: dict[str, list[str]] = {}
    for name in form.cameras:
        members.setdefault(CAMERAS[name].group, []).append(name)
    members[MOVED] = [name for name in form.cameras if name != "recorded"]
    for group, names in members.items():
        for row in rows:
            files = [[folder / row / str(seed) / f"{name}.json" for name in names] for seed in range(form.seeds)]
            solved = [[json.loads(path.read_text()) for path in of] for of in files if all(p.exists() for p in of)]
            if solved:
                groups.setdefault(group, {})[row] = np.array(solved, bool)
    return groups


def table(groups: Mapping[str, Outcomes]) -> str:
    """Markdown: success, and below it the share of the oracle's gain with its interval."""
    rows = list(dict.fromkeys(row for of in groups.values() for row in of))
    lines = ["| trained on | " + " | ".join(groups) + " | seeds |", "|---" * (len(groups) + 2) + "|"]
    for row in rows:
        cells: list[str] = []
        seeds: list[int] = []
        for of in groups.values():
            if row not in of:
                cells.append("")
                continue
            cell = f"{success(of, row).value:.2f}"
            seeds.append(len(of[row]))
            gain = None if row in (BASE, BEST) else share(of, row)
            cells.append(cell if gain is None else f"{cell}; {gain.value:.2f} ({gain.low:.2f} to {gain.high:.2f})")
        lines.append(f"| {row} | {' | '.join(cells)} | {min(seeds)} |")
    return "\n".join(lines)


def plot(groups: Mapping[str, Outcomes]) -> str:
    """SVG: success over the groups of cameras, a line per row, with 95 % intervals over tasks and seeds."""
    rows = list(dict.fromkeys(row for of in groups.values() for row in of))
    bottom, right = HEIGHT_PX - 30, WIDTH_PX - KEY_PX
    step = (right - LEFT_PX) / max(1, len(groups))

    def y(value: float) -> float:
        return bottom - value * (bottom - TOP_PX)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {HEIGHT_PX}" font-family="sans-serif" '
        f'font-size="12"><rect width="{WIDTH_PX}" height="{HEIGHT_PX}" fill="white"/>'
    ]
    for tick in np.linspace(0, 1, 6):
        parts.append(
            f'<line x1="{LEFT_PX}" x2="{right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" stroke="#ddd"/>'
            f'<text x="{LEFT_PX - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:.1f}</text>'
        )
    for number, group in enumerate(groups):
        middle = LEFT_PX + (number + 0.5) * step
        parts.append(f'<text x="{middle:.1f}" y="{HEIGHT_PX - 10}" text-anchor="middle">{escape(group)}</text>')
    for number, row in enumerate(rows):
        colour, line = COLOURS[number % len(COLOURS)], []
        for place, of in enumerate(groups.values()):
            if row in of:
                figure = success(of, row)
                x = LEFT_PX + (place + 0.5) * step + (number - len(rows) / 2) * 4
                line.append(f"{x:.1f},{y(figure.value):.1f}")
                parts.append(
                    f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y(figure.low):.1f}" y2="{y(figure.high):.1f}" '
                    f'stroke="{colour}"/><circle cx="{x:.1f}" cy="{y(figure.value):.1f}" r="3" fill="{colour}"/>'
                )
        top = TOP_PX + 18 * number + 8
        parts.append(
            f'<polyline points="{" ".join(line)}" fill="none" stroke="{colour}" stroke-width="1.5" opacity="0.6"/>'
            f'<circle cx="{right + 14}" cy="{top}" r="4" fill="{colour}"/>'
            f'<text x="{right + 24}" y="{top + 4}">{escape(row)}</text>'
        )
    return "\n".join([*parts, "</svg>\n"])
