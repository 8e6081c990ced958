"""The ablation's figures as one table and one plot."""

from collections.abc import Iterable, Sequence
from html import escape
from statistics import median
from typing import Any

MEASURES = ("all", "moving", "disoccluded")
REFERENCE = "L1-L3"  # with which every row is compared, case by case
LINE_PX, LEFT_PX, WIDTH_PX, TOP_PX, MARGIN_PX = 24, 205, 720, 46, 22
SYNTHETIC, SIMULATED = "#1f5fa8", "#c8641b"

Figures = Sequence[dict[str, Any]]


def overview_table(figures: Figures, simulated: Iterable[str]) -> str:
    """A Markdown table: synthetic scenes by the median over seeds of the mean over kinds.

    Simulated ones by the mean over scenes of the median over seeds.

    Behind the medians stand the least and the largest of the seeds.
    """
    simulated, figures = set(simulated), _own(figures)
    synthetic = [one for one in figures if one["scene"] not in simulated]
    others = [one for one in figures if one["scene"] in simulated]
    kinds, seeds = _values(synthetic, "scene"), _values(synthetic, "seed")
    head = [f"synthetic: {name}" for name in MEASURES] * bool(synthetic)
    head += [f"simulated: {name}" for name in MEASURES] * bool(others)
    lines = [f"| | {' | '.join(head)} |", "|---" * (len(head) + 1) + "|"]
    for row in _values(figures, "row"):
        cells = [_over_seeds(synthetic, row, name, kinds, seeds) for name in MEASURES] if synthetic else []
        cells += [_mean(others, row, name, _values(others, "scene")) for name in MEASURES] if others else []
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return "\n".join(lines)


def scene_table(figures: Figures) -> str:
    """PSNR over moving pixels scene by scene, with own or true priors; medians where there are several seeds."""
    scenes = list(dict.fromkeys((one["scene"], one["priors"]) for one in figures))
    lines = [f"| | {' | '.join(f'{scene}, {priors}' for scene, priors in scenes)} |", "|---" * (len(scenes) + 1) + "|"]
    for row in _values(figures, "row"):
        values = (
            [one["moving"] for one in figures if (one["row"], one["scene"], one["priors"]) == (row, *scene)]
            for scene in scenes
        )
        lines.append(f"| {row} | {' | '.join(f'{median(cell):.2f}' if cell else '' for cell in values)} |")
    return "\n".join(lines)


def plot(figures: Figures, simulated: Iterable[str]) -> str:
    """An SVG: per row a dot for each case, its PSNR over moving pixels less that of `REFERENCE`, and their median."""
    simulated, figures = set(simulated), _own(figures)
    reference = {(one["scene"], one["seed"]): one["moving"] for one in figures if one["row"] == REFERENCE}
    gains = {
        row: [
            (one["moving"] - reference[one["scene"], one["seed"]], one["scene"] in simulated)
            for one in figures
            if one["row"] == row and (one["scene"], one["seed"]) in reference
        ]
        for row in _values(figures, "row")
    }
    every = [gain for cases in gains.values() for gain, _ in cases]
    low, high = min(0, int(min(every)) - 1), int(max(every)) + 1
    height = TOP_PX + LINE_PX * len(gains) + MARGIN_PX

    def x(value: float) -> float:
        return LEFT_PX + (WIDTH_PX - LEFT_PX - MARGIN_PX) * (value - low) / (high - low)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {height}" font-family="sans-serif" '
        f'font-size="12"><rect width="{WIDTH_PX}" height="{height}" fill="white"/>',
        f'<text x="{LEFT_PX}" y="16">PSNR over moving pixels less that of {REFERENCE}, dB; one dot per case, '
        "bar: median</text>",
        f'<circle cx="8" cy="12" r="4" fill="{SYNTHETIC}"/><text x="16" y="16">synthetic</text>',
        f'<circle cx="88" cy="12" r="4" fill="{SIMULATED}"/><text x="96" y="16">simulated</text>',
    ]
    for tick in range(low, high + 1):
        parts.append(
            f'<line x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{TOP_PX - 8}" y2="{height - MARGIN_PX}" '
            f'stroke="{"#555" if tick == 0 else "#ddd"}"/><text x="{x(tick):.1f}" y="{TOP_PX - 12}" '
            f'text-anchor="middle">{tick:+d}</text>'
        )
    for number, (row, cases) in enumerate(gains.items()):
        y = TOP_PX + LINE_PX * (number + 0.5)
        parts.append(f'<text x="{LEFT_PX - 8}" y="{y + 4:.1f}" text-anchor="end">{escape(row)}</text>')
        parts += [
            f'<circle cx="{x(gain):.1f}" cy="{y:.1f}" r="3.5" fill="{SIMULATED if sim else SYNTHETIC}" opacity="0.7"/>'
            for gain, sim in cases
        ]
        if cases:
            middle = x(median(gain for gain, _ in cases))
            parts.append(
                f'<line x1="{middle:.1f}" x2="{middle:.1f}" y1="{y - 9:.1f}" y2="{y + 9:.1f}" stroke="black" '
                'stroke-width="2"/>'
            )
    return "\n".join([*parts, "</svg>\n"])


def _own(figures: Figures) -> Figures:
    """Those with the project's own priors."""
    return [one for one in figures if one["priors"] == "own"]


def _values(figures: Figures, name: str) -> list:
    """What a field is in the figures, each once, in order of appearance."""
    return list(dict.fromkeys(one[name] for one in figures))


def _over_seeds(figures: Figures, row: str, name: str, kinds: list[str], seeds: list[int]) -> str:
    """Median over the seeds of which all kinds are known, the least and the largest; of one seed its value alone."""
    means = []
    for seed in seeds:
        values = [one[name] for one in figures if one["row"] == row and one["seed"] == seed]
        if len(values) == len(kinds):
            means.append(sum(values) / len(values))
    if len(means) < 2:
        return "".join(f"{value:.2f} (one seed)" for value in means)
    return f"{median(means):.2f} ({min(means):.2f} to {max(means):.2f})"


def _mean(figures: Figures, row: str, name: str, scenes: list[str]) -> str:
    """Mean over the scenes, if all are known, each by the median of its seeds."""
    values = [[one[name] for one in figures if (one["row"], one["scene"]) == (row, scene)] for scene in scenes]
    return f"{sum(median(each) for each in values) / len(values):.2f}" if all(values) else ""
