"""What each level of motion is worth, and what other systems' models of motion would give in its place.

    python benchmarks/ablation.py [--kinds all,sheet,push,lid] [--seeds 0,1,2] [--sim FOLDER --scenes A,B] [--json FILE]
    python benchmarks/ablation.py --true_priors --rows "L1;L1-L3" [...]
    python benchmarks/ablation.py --rows paper --width 320 --steps 300 --kinds= --sim FOLDER --json PAPER.json
    python benchmarks/ablation.py --report

Every row is fitted to the same videos with the same priors (recorded depth, the project's own masks and tracks, or the
true ones), number of steps, losses and rasterizer, and rendered from held-out cameras. FILE gets a row's figures as
soon as they are known; what it holds already is not measured again, so a run that was stopped goes on. `--report`
prints the table of what FILE holds and, if L1-L3 is in it, plots it as docs/images/ablation.svg.

PSNR (dB) of a picture is over the pixels that the recorded camera has seen at some time (`all`), those of bodies that
move (`moving`), and those it saw only at another time (`disoccluded`); figures are means over cameras and frames.
Rows are without short-lived Gaussians and overlay, which hide errors of motion, unless they say so.

L1, L1+L2, L1+L2+ (ten primitives), L1-L3 and L4 (particles) are the paper's: an object is an instance, and all levels
are fitted to the tracks and kept. `of parts`: an instance is split into rigid parts first. `the method` is what the
package does: parts registered to the video, finer levels only where they prove themselves. `rgb only`: without the
losses of depth and mask. `flat 10`: Shape of Motion's model; `field`: Deformable 3D Gaussians' (rivals/); both fitted
to the tracks. `learned`: motion takes part in the fit; `afresh`: from none at all.

`paper: ...` are the recipe `paper` (the paper's method whole: docs/reconstruction.md), with one thing changed each;
`--rows paper` is all of them.
"""

import argparse
import json
import logging
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import rivals
import torch
from ablation_report import REFERENCE, overview_table, plot, scene_table
from ablation_rivals import warped_pictures, with_fixed_field, with_learned_field
from ablation_scenes import Case, HeldOut, simulated_case, synthetic_case
from jaxtyping import UInt8
from numpy import ndarray

from lerobot_msdyn.core.cli import load_recipe
from lerobot_msdyn.core.config import DensityConfig, LearnConfig, Recipe, SceneConfig
from lerobot_msdyn.core.files import write_whole
from lerobot_msdyn.evaluate.metrics import masked_psnr_db
from lerobot_msdyn.priors import Priors, estimate_priors
from lerobot_msdyn.reconstruction.background import EmptyScene, empty_scene
from lerobot_msdyn.reconstruction.fit import fit
from lerobot_msdyn.reconstruction.key_views import fixed_view
from lerobot_msdyn.reconstruction.reconstruct import Draft, reconstruct, with_steps
from lerobot_msdyn.reconstruction.result import Reconstruction
from lerobot_msdyn.render.cpu.threads import torch_on_one_thread
from lerobot_msdyn.views.pictures import new_pictures

JSON = Path(__file__).with_suffix(".json")
PLOT = Path(__file__).parent.parent / "docs" / "images" / "ablation.svg"
ALL = ["object", "primitive", "grain"]
rivals.register()
TRACKS = {"gate": False, "register": False}  # levels are fitted to the tracks, and kept
PAPER = TRACKS | {"max_parts": 1}  # and an object is an instance


SHORT_LIVED = {"short_lived": SceneConfig().short_lived}
LEARNED = {"learn": LearnConfig(bases=True, begin=0.0)}


@dataclass(frozen=True)
class Row:
    """A way to make new views; the dictionaries change fields of the recipe's parts."""

    name: str
    motion: dict[str, Any] = field(default_factory=dict)
    scene: dict[str, Any] = field(default_factory=dict)
    weights: dict[str, float] = field(default_factory=dict)
    fit: dict[str, Any] = field(default_factory=dict)
    deformation: str = ""  # whether a deformation field takes part in the fit: "on" from the tracks' motion, "afresh"
    recipe: str = ""  # what is changed; none: the default


ROWS = (
    Row("source picture"),
    Row("warp + background"),
    Row("L1", PAPER | {"levels": ["object"]}),
    Row("L1+L2", PAPER | {"levels": ["object", "primitive"]}),
    Row("L1+L2+", PAPER | {"levels": ["object", "primitive"], "primitives": 10}),
    Row("L1-L3", PAPER | {"levels": ALL}),
    Row("L4", PAPER | {"levels": [*ALL, "particle"]}),
    Row("L1-L3, rgb only", PAPER | {"levels": ALL}, weights={"depth": 0.0, "mask": 0.0}),
    Row("L1-L3, isotropic", PAPER | {"levels": ALL}, {"isotropic": True}),
    Row("L1-L3, learned", PAPER | {"levels": ALL}, fit=LEARNED),
    Row("flat 10", TRACKS | {"levels": ["flat"]}),
    Row("flat 10, learned", TRACKS | {"levels": ["flat"]}, fit=LEARNED),
    Row("field", TRACKS | {"levels": ["field"]}),
    Row("field, learned", TRACKS | {"levels": ["field"]}, deformation="on"),
    Row("field, learned afresh", TRACKS | {"levels": ["field"]}, deformation="afresh"),
    Row("L1 of parts", TRACKS | {"levels": ["object"]}),
    Row("L1-L3 of parts", TRACKS | {"levels": ALL}),
    Row("the method: registered, gated", {"levels": ALL}),
    Row("the method with short-lived Gaussians", {"levels": ALL}, SHORT_LIVED),
    Row("the method with overlay", {"levels": ALL}, SHORT_LIVED | {"overlay": True}),
)


def paper(name: str, **changes: Any) -> Row:
    """The paper's method with some of it changed."""
    changes.setdefault("motion", {"levels": ALL})
    return Row(f"paper: {name}", recipe="paper", **changes)


OTHERS = ("mask", "depth", "track", "rigidity")  # the paper's losses beside that of colour
PAPER_ROWS = (
    paper("L1", motion={"levels": ["object"]}),
    paper("L1+L2", motion={"levels": ["object", "primitive"]}),
    paper("L1+L2+", motion={"levels": ["object", "primitive"], "primitives": 10}),
    paper("L1-L3"),
    paper("L4", motion={"levels": [*ALL, "particle"]}),
    paper("L1-L3, hard objects", motion={"blend_parts": 1}),
    paper("L1-L3, bases learned alone", fit={"learn": LearnConfig(bases=True, begin=0.0)}),
    paper("L1-L3, not learned", fit={"learn": LearnConfig()}),
    paper("L1-L3, rgb only", weights=dict.fromkeys(OTHERS, 0.0)),
    *(paper(f"L1-L3, without {loss}", weights={loss: 0.0}) for loss in OTHERS),
    paper("L1-L3, without density control", fit={"density": DensityConfig()}),
    paper("L1-L3, with overlay", scene={"overlay": True}),
)


@dataclass(frozen=True)
class Settings:
    """What figures depend on; a file holds those of one choice."""

    steps: int = 100
    width: int = 160  # px
    frames: int = 40  # of synthetic scenes
    every: int = 8  # frames of synthetic scenes with truth
    stride: int = 2  # frames of simulated episodes that are used ...
    sim_every: int = 3  # ... and of those with truth


@dataclass(frozen=True)
class Prepared:
    """What all rows of a case share."""

    case: Case
    priors: Priors
    empty: EmptyScene


def recipe_of(row: Row, settings: Settings, seed: int) -> Recipe:
    """A row's recipe with its changes."""
    recipe = replace(load_recipe(row.recipe) if row.recipe else Recipe(), seed=seed)
    recipe.priors.cache = "off"
    recipe.scene = replace(recipe.scene, **({"overlay": False, "short_lived": 0} | row.scene))
    recipe.motion = replace(recipe.motion, **row.motion)
    weights = recipe.fit.weights | row.weights
    recipe.fit = replace(recipe.fit, steps=settings.steps, max_width=settings.width, weights=weights, **row.fit)
    return recipe


def prepare(case: Case) -> Prepared:
    """The priors of a case's video: the project's own, or the truth where the case has it."""
    recipe = recipe_of(ROWS[0], Settings(), case.seed)
    priors = estimate_priors(case.view, recipe.priors, recipe.camera)
    if case.truth is not None:
        priors = replace(priors, instances=case.truth.instances, tracks=case.truth.tracks)
    return Prepared(case, priors, empty_scene(case.view.rgb, priors.depth, priors.instances))


def reconstructed(prepared: Prepared, row: Row, recipe: Recipe) -> Reconstruction:
    """A row's scene: the package's own steps on given priors, with a field that is learned where the row says so."""

    def given_priors(draft: Draft) -> None:
        draft.priors = prepared.priors

    def given_background(draft: Draft) -> None:
        draft.stand_before(fixed_view(prepared.empty, draft.view.camera))

    def fitted(draft: Draft) -> None:
        scene = draft.scene
        learned: list[dict[str, Any]] = []
        if row.deformation:
            scene, learned = with_learned_field(scene, afresh=row.deformation == "afresh")
        draft.fitted = fit(
            scene,
            draft.view,
            draft.priors,
            recipe.fit,
            empty=draft.keys[0].empty.rgb,
            distance=draft.distance,
            seed=recipe.seed,
            learned=learned,
        )
        draft.scene = with_fixed_field(draft.fitted.scene)

    steps = with_steps({"priors": given_priors, "background": given_background, "fit": fitted})
    return reconstruct(prepared.case.view, recipe, steps=steps)


def pictures(
    prepared: Prepared, row: Row, settings: Settings
) -> Iterator[tuple[HeldOut, list[UInt8[ndarray, "h w 3"]]]]:
    """What a row shows of each held-out camera."""
    case = prepared.case
    if row.motion:
        scene = reconstructed(prepared, row, recipe_of(row, settings, case.seed))
    for heldout in case.heldout:
        if row.motion:
            frames = torch.from_numpy(heldout.frames).long()
            yield heldout, [picture.rgb for picture in new_pictures(scene, heldout.camera, frames)]
        elif row.name == "source picture":
            yield heldout, list(case.view.rgb[torch.from_numpy(heldout.frames)].numpy())
        else:
            yield heldout, list(warped_pictures(case, prepared.priors, prepared.empty, heldout))


def measured(prepared: Prepared, row: Row, settings: Settings) -> dict[str, Any]:
    """A row's figures on one case."""
    start = time.process_time()
    scores: dict[str, list[float]] = {"all": [], "moving": [], "disoccluded": []}
    for heldout, shown in pictures(prepared, row, settings):
        for i, picture in enumerate(shown):
            seen = heldout.seen[i]
            masks = {"all": seen > 0, "moving": (seen > 0) & heldout.moving[i], "disoccluded": seen == 1}
            for name, mask in masks.items():
                if mask.any():
                    scores[name].append(masked_psnr_db(picture, heldout.rgb[i], mask))
    means = {name: round(float(np.mean(values)), 3) for name, values in scores.items()}
    case = prepared.case
    priors = "own" if case.truth is None else "true"
    place = {"scene": case.name, "seed": case.seed, "priors": priors, "row": row.name}
    return place | means | {"cpu_s": round(time.process_time() - start, 1)}


def cases(options: argparse.Namespace, settings: Settings) -> Iterator[tuple[str, int, Any]]:
    """Name, seed and maker of every case."""
    for seed in options.seeds:
        for kind in options.kinds:
            yield (
                kind,
                seed,
                lambda kind=kind, seed=seed: synthetic_case(
                    kind, seed, settings.frames, settings.width, settings.every, true_priors=options.true_priors
                ),
            )
    for scene in options.scenes if options.sim and not options.true_priors else ():
        for seed in options.sim_seeds:
            yield (
                scene,
                seed,
                lambda scene=scene, seed=seed: simulated_case(
                    options.sim / scene, seed, settings.width, settings.stride, settings.sim_every
                ),
            )


def read(path: Path, settings: Settings) -> list[dict[str, Any]]:
    """The figures that a file holds; they must be of the same settings."""
    if not path.exists():
        return []
    content = json.loads(path.read_text())
    if content["settings"] != asdict(settings):
        sys.exit(f"{path} holds figures of {content['settings']}; expected {asdict(settings)}; choose another --json")
    return content["figures"]


def run(options: argparse.Namespace, settings: Settings) -> None:
    """Measure what the file does not hold yet."""
    figures = read(options.json, settings)
    priors = "true" if options.true_priors else "own"
    done = {(one["scene"], one["seed"], one["row"]) for one in figures if one["priors"] == priors}
    for name, seed, make in cases(options, settings):
        rows = [row for row in (*ROWS, *PAPER_ROWS) if row.name in options.rows and (name, seed, row.name) not in done]
        if not rows:
            continue
        prepared = prepare(make())
        for row in rows:
            result = measured(prepared, row, settings)
            figures.append(result)
            content = {"settings": asdict(settings), "figures": figures}
            write_whole(options.json, (json.dumps(content, indent=1) + "\n").encode())
            print("  ".join(f"{value}" for value in result.values()), flush=True)


def words(text: str) -> list[str]:
    return [word for word in text.split(",") if word]


def main(arguments: list[str]) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", type=words, default=["all", "sheet", "push", "lid"], help="of synthetic scenes")
    parser.add_argument("--seeds", type=lambda text: [int(word) for word in words(text)], default=[0, 1, 2])
    parser.add_argument("--sim", type=Path, help="folder of simulated episodes (docs/evaluate.md)")
    parser.add_argument("--scenes", type=words, default=["rigid_push", "pick_place", "deformable", "free_arm"])
    parser.add_argument("--true_priors", action="store_true", help="true masks and tracks, of synthetic scenes alone")
    parser.add_argument("--sim_seeds", type=lambda text: [int(word) for word in words(text)], default=[0])
    names, of_paper = ([row.name for row in rows] for rows in (ROWS, PAPER_ROWS))
    parser.add_argument(
        "--rows",
        type=lambda text: of_paper if text == "paper" else text.split(";"),
        default=names,
        help="; between them, or: paper",
    )
    parser.add_argument("--json", type=Path, default=JSON)
    parser.add_argument("--report", action="store_true", help="print tables of the figures, and plot them")
    for name, value in asdict(Settings()).items():
        parser.add_argument(f"--{name}", type=int, default=value)
    options = parser.parse_args(arguments)
    logging.disable(logging.WARNING)
    settings = Settings(**{name: getattr(options, name) for name in asdict(Settings())})
    if options.report:
        figures = read(options.json, settings)
        print(overview_table(figures, options.scenes), scene_table(figures), sep="\n\n")
        if any(figure["row"] == REFERENCE for figure in figures):
            write_whole(PLOT, plot(figures, options.scenes).encode())
    else:
        with torch_on_one_thread():
            run(options, settings)


if __name__ == "__main__":
    main(sys.argv[1:])
