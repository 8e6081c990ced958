"""What it is worth that episodes of a walking camera share what stands still: one view per seed, with and without.

    python benchmarks/walks.py --out FOLDER [--seeds 0 1 2] [--width 320] [--frames 24] [--steps 200] [--others 3]
        [--depth recorded|network|disparity]

Episode 0 is recorded from -25 to -5 degrees of azimuth about a simulated desk, the others from -10 to 20; the arm
pushes a block in each, from another place. Episode 0 is seen from 12 degrees further on, and from 12 degrees back,
where nobody was. Depth is recorded, or as a network would give it, in metres or as inverse depth without factor and
shift; poses are those of the simulation (`--noise` adds some), masks and tracks are the product's own. PSNR against the
truth, of what stands still: where episode 0 alone covers the view ("own"), and where sharing covers it in addition
("new").
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lerobot_msdyn.core.cameras import static_camera
from lerobot_msdyn.core.cli import load_recipe
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.geometry import axis_angle_to_matrix, se3
from lerobot_msdyn.core.observations import View
from lerobot_msdyn.priors.exchange import Exchange, write_exchange
from lerobot_msdyn.reconstruction.reconstruct import reconstruct
from lerobot_msdyn.reconstruction.share_background import shown_by
from lerobot_msdyn.render.cpu.threads import torch_on_one_thread
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.rough_depth import rough_depth
from lerobot_msdyn.synthetic.scene import SyntheticScene
from lerobot_msdyn.synthetic.viewpoints import walking_camera
from lerobot_msdyn.views.pictures import new_pictures

KEY = "observation.images.front"
OWN, OTHERS, ASIDE = (-25.0, -5.0), (-10.0, 20.0), 12.0  # degrees of azimuth


def recorded(
    seed: int, episode: int, arc: tuple[float, float], options: argparse.Namespace
) -> tuple[SyntheticScene, View]:
    """One episode, and its poses in a file."""
    frames, width, height = options.frames, options.width, options.width * 3 // 4
    scene = make_scene("push", seed, frames, width, height, episode=episode)
    camera = walking_camera(frames, width, height, arc)
    seen = scene.render(camera)
    w2c, rng = camera.camera_from_world.double(), np.random.default_rng([seed, episode])
    for t in range(frames if options.noise else 0):
        turn = axis_angle_to_matrix(torch.from_numpy(rng.normal(0, np.radians(0.3) / 3**0.5, 3)))
        w2c[t] = se3(turn, torch.from_numpy(rng.normal(0, 0.003 / 3**0.5, 3))) @ w2c[t]
    content = Exchange(
        frames,
        height,
        width,
        episode,
        KEY,
        K=camera.intrinsics.numpy(),
        w2c=w2c.float().numpy(),
        world="desk",
    )
    depth = None
    if options.depth != "recorded":
        depth = rough_depth(seen.depth.numpy(), rng)
        kind = "metric" if options.depth == "network" else "affine_disparity"
        content = replace(content, depth=depth if kind == "metric" else 1 / depth + 0.3, depth_kind=kind)
    write_exchange(options.out / f"poses_{seed}_{episode}.npz", content)
    assumed = static_camera(camera.intrinsics[0], frames, width, height)
    return scene, View(seen.rgb, assumed, seen.depth if depth is None else None)


def measured(seed: int, recipe: Recipe, options: argparse.Namespace) -> list[dict[str, float]]:
    """The figures of one seed, a row per view."""
    file = f"{options.out}/poses_{seed}_{{episode}}.npz"
    recipe = replace(recipe, camera=replace(recipe.camera, poses=file))
    if options.depth != "recorded":
        recipe = replace(recipe, priors=replace(recipe.priors, depth=file))
    scene, view = recorded(seed, 0, OWN, options)
    recordings = {episode: recorded(seed, episode, OTHERS, options)[1] for episode in range(1, options.others + 1)}
    start = time.process_time()
    with torch_on_one_thread():
        others = [shown_by(view, recipe, episode, KEY) for episode, view in recordings.items()]
    offered_s = (time.process_time() - start) / max(1, options.others)
    backgrounds = [other for other in others if other is not None]
    runs = []
    for given in ([], backgrounds):
        start = time.process_time()
        found = reconstruct(view, recipe, backgrounds=given, episode=0, key=KEY)
        runs.append((found, time.process_time() - start))
    rows = []
    for name, aside in (("on", ASIDE), ("back", -ASIDE)):
        camera = walking_camera(options.frames, view.camera.width, view.camera.height, (OWN[0] + aside, OWN[1] + aside))
        frames = list(range(0, options.frames, 3))
        camera, truth = camera.select(frames), scene.render(camera.select(frames), frames)
        pictures = [[*new_pictures(found, camera, torch.tensor(frames))] for found, _ in runs]
        unseen = [np.stack([picture.unseen for picture in some]) for some in pictures]
        still = (truth.instances == 0).numpy()
        shown = {"own": ~unseen[0] & still, "new": unseen[0] & ~unseen[1] & still, "all": still}
        row = {"seed": seed, "on": float(name == "on"), "offered cpu s": offered_s}
        for kind, some, hidden, (found, seconds) in zip(("alone", "shared"), pictures, unseen, runs, strict=True):
            row[f"{kind} uncovered %"] = 100 * hidden.mean()
            row[f"{kind} cpu s"] = seconds
            row[f"{kind} background s"] = found.seconds["background"]
            error = np.square(np.stack([picture.rgb for picture in some]) / 255.0 - truth.rgb.numpy() / 255.0).mean(-1)
            for where, mask in shown.items():
                row[f"{kind} {where} dB"] = -10 * np.log10(error[mask].mean()) if mask.any() else np.nan
        rows.append(row)
    return rows


def main() -> None:
    """Print the figures, a line per seed and view."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="where poses are written")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--others", type=int, default=3, help="episodes beside")
    parser.add_argument("--depth", choices=("recorded", "network", "disparity"), default="recorded")
    parser.add_argument("--noise", action="store_true", help="poses with 0.3 degrees and 3 mm of noise per frame")
    options = parser.parse_args()
    recipe = load_recipe("balanced")
    recipe = replace(recipe, fit=replace(recipe.fit, steps=options.steps), priors=replace(recipe.priors, cache="off"))
    for seed in options.seeds:
        for row in measured(seed, recipe, options):
            print("  ".join(f"{name} {value:.2f}" for name, value in row.items()), flush=True)


if __name__ == "__main__":
    main()
