"""The page itself: one HTML file with everything in it; every text from outside is escaped."""

import html
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_msdyn.augment.report.drawing import cameras_from_above
from lerobot_msdyn.reconstruction.account import Account, account_sentence, pooled

LISTED = 1000  # rows of the table, at most
GOOD_DB = 20.0  # expected; below it a view is doubtful (docs/views.md has how often the score is right there)
ASSUMED_DEG = 5.0  # a view turned by more is doubtful where depth is assumed: it harms policies (docs/results.md)
SHOWN_POSES = 8  # of a camera that moves along the episode, about
TOLD_PX = 1.5  # of 320: a camera that drifts or is displaced by less is not named
STYLE = """
:root{--ink:#1c2330;--soft:#5c6675;--line:#dde2e8;--paper:#fff;--back:#f5f6f8;--new:#c2351f;--good:#1d7a46;
--doubtful:#8a5a00}
@media (prefers-color-scheme:dark){:root{--ink:#e6e9ee;--soft:#9aa5b4;--line:#2c3542;--paper:#171d26;--back:#0e1319;
--new:#ff7a63;--good:#5fce93;--doubtful:#e0aa4a}}
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--ink);font:15px/1.5 system-ui,"Segoe UI",Roboto,sans-serif}
main{max-width:1180px;margin:0 auto;padding:24px 20px 60px}
h1{font-size:26px;line-height:1.25;margin:0 0 4px}h2{font-size:20px;margin:36px 0 12px}
h3{font-size:16px;margin:0;overflow-wrap:anywhere}
p{margin:0 0 10px}.soft{color:var(--soft)}
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(128px,1fr));gap:12px;margin:18px 0}
.figures div{background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:10px 14px}
.figures b{display:block;font-size:22px;font-weight:600}
article{background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:16px;margin:0 0 18px}
.head{display:flex;flex-wrap:wrap;gap:4px 14px;align-items:baseline;justify-content:space-between;margin-bottom:12px}
.lead{font-size:18px;margin:10px 0}.score,td.good,td.doubtful,td.dropped{font-weight:600}
.good .score,td.good{color:var(--good)}.doubtful .score,td.doubtful{color:var(--doubtful)}
.dropped .score,td.dropped,.why{color:var(--new)}
.grid{display:grid;grid-template-columns:2fr 1fr 1fr;gap:16px;margin-top:14px;align-items:start}
figure{margin:0;min-width:0}figcaption{color:var(--soft);font-size:13px;margin-top:4px}
img,svg{display:block;width:100%;height:auto;border-radius:4px}
.film{width:100%;background-size:calc(100% * var(--frames)) 100%;border-radius:4px;
animation:film calc(var(--frames) * .16s) steps(var(--frames),jump-none) infinite}
@keyframes film{from{background-position:0 0}to{background-position:100% 0}}
@media (prefers-reduced-motion:reduce){.film,.turns .other{animation:none}.turns:hover .other{opacity:0}}
svg{background:var(--back);max-width:320px}
.why{margin:12px 0 0}
svg .recorded{fill:#8b95a3;stroke:#8b95a3}svg .new{fill:var(--new);stroke:var(--new)}
svg polygon.recorded{fill:none;stroke-width:2}
svg .sight{stroke-width:1;stroke-dasharray:3 4;opacity:.6}svg .target{fill:none;stroke:var(--ink);stroke-width:1.5}
.scroll{overflow-x:auto}.sheet img{min-width:640px}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:8px;margin-top:8px}
.pair div,.turns div{aspect-ratio:var(--ratio);background-size:100% 100%;border-radius:4px}
.one{background-image:var(--one)}.other{background-image:var(--other)}
.turns{display:grid;max-width:960px;margin-top:8px}.turns div{grid-area:1/1}
.turns .other{animation:turns 1.6s steps(1) infinite}
@keyframes turns{50%{opacity:0}}
pre{overflow-x:auto;font-size:13px}
table{border-collapse:collapse;width:100%;font-size:14px;background:var(--paper)}
th,td{text-align:left;padding:6px 10px;border-bottom:1px solid var(--line);white-space:nowrap}
td.text{white-space:normal;min-width:220px;overflow-wrap:anywhere}
th{color:var(--soft);font-weight:600;white-space:normal}
dl{display:grid;grid-template-columns:repeat(auto-fill,minmax(136px,1fr));gap:8px 16px;margin:14px 0 0}
dl .wide{grid-column:span 2}
dt{color:var(--soft);font-size:13px}dd{margin:0;font-weight:600}
ul{margin:8px 0 0;padding-left:20px}li{overflow-wrap:anywhere}
details{margin-top:12px}summary{cursor:pointer;color:var(--soft)}
@media (max-width:760px){main{padding:16px 12px 40px}h1{font-size:22px}.grid{grid-template-columns:1fr 1fr}
.grid figure:first-child{grid-column:span 2}article{padding:12px}}
"""
MEANING = (
    "Recorded pictures are on the left and above, rendered ones on the right and below. Expected quality is an "
    "estimate, since no camera stood where the new one does: how close a rendered picture comes to the one that it "
    f"would have recorded, as PSNR in dB (more is better). A view is called good from {GOOD_DB:.0f} dB on; look at the "
    "others before you train on them. Depth that is wrong in the same way in all frames is not noticed."
)
ASSUMED = (
    "Depth was assumed here (a table plane), and nothing can tell whether it is right: look at what moves before you "
    "trust these scores."
)
ADVICE_FOR = ("doubtful", "dropped")
# Cause of most of the expected error of those views -> what to do.
ADVICE = {
    "video": "the scene does not match its own video; look at the masks (the command priors), or fit it for longer "
    "(--recipe best)",
    "geometry": "the scene's shape is doubtful; look at masks and depth (the command priors)",
    "depth": "depth is a guess; lower --perturbation.azimuth_deg, or supply depth (a depth camera, a depth model, or "
    "the robot's joints by --robot.name)",
    "sampling": "the pictures are finer than can be rendered from elsewhere; nothing is wrong",
}
# Score -> (name, how it is written).
NAMES = {
    "expected_db": ("expected quality", "{:.1f} dB"),
    "held_out_db": ("recorded view, held-out frames", "{:.1f} dB"),
    "held_out_ssim": ("the same, SSIM", "{:.3f}"),
    "moving_with_overlay_db": ("dynamic PSNR, recorded view", "{:.1f} dB"),
    "moving_db": ("dynamic PSNR by motion alone", "{:.1f} dB"),
    "by_motion": ("moving pixels by motion", "{:.0%}"),
    "by_short_lived": ("moving pixels by short-lived Gaussians", "{:.0%}"),
    "by_overlay": ("moving pixels by overlay", "{:.0%}"),
    "unseen": ("uncovered", "{:.1%}"),
    "angle_deg": ("change of the line of sight", "{:.1f}°"),
    "track_px": ("tracks to motion", "{:.1f} px"),
    "flicker_ratio": ("flicker, of the video's", "{:.2f}"),
    "sharpness_ratio": ("sharpness, of the video's", "{:.2f}"),
}


@dataclass(frozen=True)
class Pictures:
    """Pictures of one view, as data URLs."""

    strip: str
    film: str
    film_frames: int
    ratio: float  # width by height of one step of the film
    heat: str | None
    one: str  # the frame in the middle at full size, recorded ...
    other: str  # ... and new


@dataclass(frozen=True)
class ViewEntry:
    """One new episode by one camera."""

    episode: int  # of the source
    variant: int
    camera: str
    amounts: dict[str, float]  # the change of view
    view: dict[str, Any]  # camera_from_source, distance_m, what_moves, defects, camera, and scores if it was judged
    rejected: list[str]  # reasons of the samples before
    dropped: bool
    pictures: Pictures | None = None
    pair: str | None = None  # of a dropped view: a frame of it beside the recorded one, as a data URL
    sheet: Path | None = None  # the priors of its episode
    frame: Path | None = None  # of a dropped view
    assumed: bool = False  # whether its depth is that of a plane that nobody has measured

    @property
    def scores(self) -> dict[str, Any] | None:
        """What the gate measured; None: it did not look."""
        return self.view.get("scores")

    @property
    def score(self) -> float:
        """Expected quality in dB; views that were not judged come last."""
        return float(self.view.get("scores", {}).get("expected_db", float("inf")))

    @property
    def verdict(self) -> str:
        """What to think of it: good, doubtful, not judged, or dropped."""
        if self.dropped:
            return "dropped"
        if self.scores is None:
            return "not judged"
        return "good" if self.score >= GOOD_DB and not self.too_far else "doubtful"

    @property
    def too_far(self) -> bool:
        """Whether it is turned by more than assumed depth allows."""
        return self.assumed and self.scores is not None and self.scores["angle_deg"] > ASSUMED_DEG


@dataclass(frozen=True)
class Origin:
    """What a dataset was made of, and how."""

    facts: Mapping[str, str] = field(default_factory=dict)  # by name: source, date, versions, depth
    assumed_depth: bool = False  # whether scenes stand on a table plane that nobody has measured
    recipe: str = ""  # YAML
    sheets: Mapping[str, str] = field(default_factory=dict)  # pictures of priors, as data URLs, by what they are of
    links: Mapping[str, str] = field(default_factory=dict)  # the same of a robot's links over the video


def page(
    title: str,
    figures: dict[str, str],
    entries: Sequence[ViewEntry],
    skipped: Sequence[str],
    origin: Origin = Origin(),
) -> str:
    """The whole report.

    Args:
        title: name of the dataset.
        figures: what to say at the top, by name.
        entries: all views; those with pictures are shown at length.
        skipped: why source episodes were left out, one line per reason.
        origin: what the dataset was made of.
    """
    shown = [entry for entry in worst_first(entries) if entry.pictures is not None or entry.dropped]
    top = "".join(f"<div><b>{text(value)}</b>{text(name)}</div>" for name, value in figures.items())
    left_out = ""
    if skipped:
        left_out = "<h2>Skipped episodes</h2>" + bullets(skipped)
    noted = dict.fromkeys(
        f"episode {entry.episode}, {entry.camera}: {line}"
        for entry in entries
        for line in entry.view.get("defects", [])
    )
    if noted:
        left_out += "<h2>Recorded pictures</h2>" + bullets(list(noted)[:LISTED])
    moves = bullets(f"{camera}: {account_sentence(account)}" for camera, account in accounts_of(entries).items())
    more = len(entries) - min(len(entries), LISTED)
    rest = f"<p class=soft>{more} more are in meta/msdyn/episodes.parquet.</p>" if more else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{text(title)}</title><style>{STYLE}</style></head><body><main>"
        f'<h1>{text(title)}</h1><p class="lead">{text(summary(entries))}</p>'
        f"{f'<p>{text(ASSUMED)}</p>' if origin.assumed_depth else ''}"
        f'<p class="soft">{text(MEANING)}</p>'
        f'<div class="figures">{top}</div>{left_out}'
        f"<h2>Views, worst first</h2>{''.join(_article(entry) for entry in shown[:LISTED])}"
        f'<h2>All views</h2><div class="scroll">{_table(entries[:LISTED])}</div>{rest}'
        f"<h2>What moves</h2>{moves}{_cameras(entries)}{_sheets(origin.sheets)}{_links(origin.links)}{_origin(origin)}"
        "</main></body></html>\n"
    )


def worst_first(entries: Iterable[ViewEntry]) -> list[ViewEntry]:
    """The views in the order in which to look at them: dropped ones, then by their scores."""
    return sorted(entries, key=lambda entry: (not entry.dropped, entry.score))


def summary(entries: Sequence[ViewEntry]) -> str:
    """How many views are good, and what would make the others better."""
    if not entries:
        return "No new views."
    count = Counter(entry.verdict for entry in entries)
    said = [f"{number} {name}" for name, number in count.items() if name != "good"]
    opening = f"{count['good']} of {len(entries)} views good{''.join(f', {part}' for part in said)}"
    doubtful = [entry.scores["causes"] for entry in entries if entry.verdict in ADVICE_FOR and entry.scores]
    if not doubtful:
        return f"{opening}."
    cause = max(ADVICE, key=lambda name: sum(causes.get(name, 0.0) for causes in doubtful))
    if any(entry.too_far for entry in entries):
        cause = "depth"
    return f"{opening}: {ADVICE[cause]}."


def accounts_of(entries: Iterable[ViewEntry]) -> dict[str, Account]:
    """Per camera, what renders the moving pixels of its recorded view, over all episodes."""
    accounts = {(entry.camera, entry.episode): Account.from_entry(entry.view["what_moves"]) for entry in entries}
    return {
        camera: pooled([account for (name, _), account in accounts.items() if name == camera])
        for camera in dict.fromkeys(camera for camera, _ in accounts)
    }


def camera_lines(entries: Iterable[ViewEntry]) -> list[str]:
    """Where a recorded camera was not where it was before, a line each; px of 320."""
    cameras = {(entry.camera, entry.episode): entry.view["camera"] for entry in entries if "camera" in entry.view}
    lines: list[str] = []
    places: dict[str, float] = {}
    for (key, episode), camera in cameras.items():
        where = f"{key}, episode {episode}"
        if "path_m" in camera:
            lines.append(f"{where}: it moves along {camera['path_m']:.2f} m, by its poses")
            continue
        if not camera["stands"]:
            lines.append(f"{where}: it moves, by {camera['drift_px']} px")
            continue
        lines += [f"{where}: moved by {step['px']} px before frame {step['frame']}" for step in camera["moved"]]
        if camera["drift_px"] > TOLD_PX:
            lines.append(f"{where}: drifts by {camera['drift_px']} px")
        displaced = camera["displaced_px"]
        if displaced is not None and abs(displaced - places.get(key, 0.0)) > TOLD_PX:
            lines.append(f"{where}: begins {displaced} px from where episode 0 does")
        places[key] = places.get(key, 0.0) if displaced is None else displaced
    return lines


def _cameras(entries: Sequence[ViewEntry]) -> str:
    lines = camera_lines(entries)
    more = [f"{len(lines) - LISTED} more are in meta/msdyn/episodes.parquet"] if len(lines) > LISTED else []
    what = bullets(lines[:LISTED] + more) if lines else "<p>They keep still.</p>"
    return f"<h2>Did the recorded cameras move? (px, at a width of 320)</h2>{what}"


def _sheets(pictures: Mapping[str, str]) -> str:
    if not pictures:
        return ""
    shown = "".join(
        f'<p>{text(name)}</p><div class="scroll sheet"><img src="{url}" alt="priors of {text(name)}"></div>'
        for name, url in pictures.items()
    )
    return (
        '<h2>What was estimated from the recording</h2><p class="soft">Over time: the picture, what moves, depth, and '
        f"the tracks of what moves. Where one of these is wrong, so are the new views.</p>{shown}"
    )


def _origin(origin: Origin) -> str:
    if not origin.facts:
        return ""
    facts = "".join(
        f"<tr><th>{text(name)}</th><td class=text>{text(fact)}</td></tr>" for name, fact in origin.facts.items()
    )
    recipe = f"<details><summary>Recipe</summary><pre>{text(origin.recipe)}</pre></details>" if origin.recipe else ""
    return f'<h2>How it was made</h2><div class="scroll"><table>{facts}</table></div>{recipe}'


def _links(pictures: Mapping[str, str]) -> str:
    if not pictures:
        return ""
    shown = "".join(f'<p>{text(name)}</p><img src="{url}" alt="{text(name)}">' for name, url in pictures.items())
    return f"<h2>Where the joints say that the robot is</h2>{shown}"


def text(value: object) -> str:
    """Text that is safe in the page, also inside quotes."""
    return html.escape(str(value), quote=True)


def bullets(lines: Iterable[str]) -> str:
    """A list."""
    return "<ul>" + "".join(f"<li>{text(line)}</li>" for line in lines) + "</ul>"


def _article(entry: ViewEntry) -> str:
    scores = entry.scores
    score = f"{entry.verdict}: {scores['expected_db']:.1f} dB expected" if scores else entry.verdict
    why = ""
    if entry.rejected:
        name = "Why it was dropped" if entry.dropped else "Sampled again, since"
        why = f'<p class="why">{name}:</p>{bullets(dict.fromkeys(entry.rejected))}'
    return (
        f'<article class="{entry.verdict}"><div class="head"><h3>Episode {entry.episode}, variant {entry.variant}, '
        f'{text(entry.camera)}</h3><span class="score">{text(score)}</span></div>{_pictures(entry)}'
        f"{_scores(scores) if scores else ''}{why}{_frames(scores['frames']) if scores else ''}</article>"
    )


def _pictures(entry: ViewEntry) -> str:
    change = text(", ".join(_with_unit(name, value) for name, value in entry.amounts.items()))
    above = (
        f"<figure>{cameras_from_above(_poses(entry.view['camera_from_source']), entry.view['distance_m'])}"
        f"<figcaption>From above: recorded camera grey, new one red. {change}</figcaption></figure>"
    )
    pictures = entry.pictures
    if pictures is None:
        pair = ""
        if entry.pair:
            pair = (
                f'<figure><img src="{entry.pair}" alt="recorded left, new right">'
                "<figcaption>A frame of it: recorded left, new right</figcaption></figure>"
            )
        return f'<div class="grid">{pair}{above}</div>'
    heat = ""
    if pictures.heat:
        heat = (
            f'<figure><img src="{pictures.heat}" alt="where the new view shows what no frame has shown">'
            "<figcaption>Red: uncovered, filled in</figcaption></figure>"
        )
    return (
        f'<figure class="strip"><img src="{pictures.strip}" alt="recorded above, new below"></figure>'
        '<div class="grid"><figure><div class="film" role="img" aria-label="clip: recorded left, new right" '
        f'style="--frames:{pictures.film_frames};aspect-ratio:{pictures.ratio:.4f};'
        f"background-image:url('{pictures.film}')\"></div>"
        f"<figcaption>Recorded left, new right</figcaption></figure>{heat}{above}</div>"
        f"<details style=\"--ratio:{pictures.ratio / 2:.4f};--one:url('{pictures.one}');"
        f"--other:url('{pictures.other}')\">"
        "<summary>Full size: recorded and new in turn, and side by side</summary>"
        '<div class="turns" role="img" aria-label="recorded and new in turn"><div class="one"></div>'
        '<div class="other"></div></div><div class="pair" role="img" aria-label="recorded left, new right">'
        '<div class="one"></div><div class="other"></div></div></details>'
    )


def _poses(matrices: list[Any]) -> list[Any]:
    """A few of a camera's poses: one, or some along an episode in which it moves."""
    every = max(1, len(matrices) // SHOWN_POSES)
    return matrices[::every] if isinstance(matrices[0][0], list) else [matrices]


def _with_unit(name: str, value: float) -> str:
    """What was sampled, in words: its name ends in its unit."""
    for ending, unit in (("_deg", "°"), ("_m", " m"), ("_rel", " of the distance")):
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} {value:.3g}{unit}"
    return f"{name.replace('_', ' ')} {value:.3g}"


def _scores(scores: dict[str, Any]) -> str:
    items = "".join(
        f"<div><dt>{name}</dt><dd>{text(form.format(scores[key]))}</dd></div>" for key, (name, form) in NAMES.items()
    )
    cause = ", ".join(f"{name} {share:.0%}" for name, share in scores["causes"].items())
    return f'<dl>{items}<div class="wide"><dt>expected error from</dt><dd class="soft">{text(cause)}</dd></div></dl>'


def _frames(frames: Sequence[dict[str, Any]]) -> str:
    rows = "".join(
        f"<tr><td>{frame['frame']:.0f}</td><td>{frame['expected_db']:.1f} dB</td><td>{frame['unseen']:.1%}</td>"
        f"<td>{frame['angle_deg']:.1f}°</td><td>{frame['sharpness_ratio']:.2f}</td></tr>"
        for frame in frames
    )
    head = "<tr><th>frame</th><th>expected</th><th>uncovered</th><th>angle</th><th>sharpness</th></tr>"
    return f'<details><summary>Judged frames</summary><div class="scroll"><table>{head}{rows}</table></div></details>'


def _table(entries: Sequence[ViewEntry]) -> str:
    head = (
        "<tr><th>episode</th><th>variant</th><th>camera</th><th>drift, px of 320</th><th>expected</th>"
        "<th>uncovered</th><th>by motion</th>"
        "<th>short-lived</th><th>by overlay</th><th>dynamic PSNR</th><th>by motion alone</th>"
        "<th>resampled</th><th>verdict</th></tr>"
    )
    rows = []
    for entry in entries:
        scores = entry.scores
        values = (f"{scores['expected_db']:.1f} dB", f"{scores['unseen']:.1%}") if scores else ("not judged", "")
        verdict = f"dropped: {entry.rejected[-1]}" if entry.dropped else entry.verdict
        resampled = len(entry.rejected) - int(entry.dropped)
        moves = "".join(f"<td>{cell}</td>" for cell in _account_cells(entry.view["what_moves"]))
        rows.append(
            f"<tr><td>{entry.episode}</td><td>{entry.variant}</td><td>{text(entry.camera)}</td>"
            f"<td>{entry.view.get('camera', {}).get('drift_px', '')}</td><td>{values[0]}</td>"
            f'<td>{values[1]}</td>{moves}<td>{resampled}</td><td class="text {entry.verdict}">{text(verdict)}</td></tr>'
        )
    return f"<table>{head}{''.join(rows)}</table>"


def _account_cells(account: dict[str, Any]) -> list[str]:
    """By motion, by short-lived Gaussians, by overlay; dynamic PSNR of all and by motion alone."""
    if account["pixels"] == 0:
        return ["nothing moves", "", "", "", ""]
    shares = [f"{account[name]:.0%}" for name in ("by_motion", "by_short_lived", "by_overlay")]
    return [*shares, *(f"{account[name]:.1f} dB" for name in ("dynamic_db", "dynamic_by_motion_db"))]
