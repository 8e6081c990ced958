"""Every field that a recipe or a flag can set, with its default, unit and meaning (the comments are the help texts).

No torch here, so that `--help` answers at once. Recipes are YAML files with the fields of `Recipe`; any field can be
overridden by a flag of the same dotted name, e.g. `--fit.steps 1000`.
"""

from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Literal

import draccus

# Named: draccus finds the comment above a field only where its annotation holds no quotes.
Device = Literal["auto", "cpu", "cuda"]
Fill = Literal["inpaint", "nearest", "none"]
Protocol = Literal["som", "dycheck"]
LevelName = Literal["object", "primitive", "grain", "particle", "flat", "field"]


@dataclass
class CameraConfig:
    """Where the cameras' geometry comes from."""

    # JSON file with K (and R, t) of each camera, see docs/calibration.md; without it the camera is taken as fixed.
    calibration: Path | None = None
    # auto (the calibration, else fixed), fixed, sfm (pycolmap, for a moving camera), or an .npz file with K and w2c.
    poses: str = "auto"
    # Horizontal field of view in degrees, used where no calibration names the camera.
    horizontal_fov_deg: float = 60.0
    # Look for the field of view at which rigid things keep their size; needs depth other than the plane's.
    fov_search: bool = False
    # Height of the camera above the table in metres, used where no depth is recorded.
    height_m: float = 0.5
    # Downward tilt of the camera in degrees, used where no depth is recorded.
    tilt_deg: float = 35.0


@dataclass
class PriorsConfig:
    """What is known about a video before the fit."""

    # auto (recorded, else a learned model that is on this machine, else stereo, else plane), recorded, plane,
    # depth_anything, depth_anything_metric, stereo (two or more calibrated cameras), or an .npz file.
    depth: str = "auto"
    # auto (a learned model that is on this machine, else change), change, sam2, edgetam, or an .npz file.
    masks: str = "auto"
    # auto (raft if its weights are on this machine, else flow), flow, raft, or an .npz file.
    tracks: str = "auto"
    # Model of `depth_anything`: an id on the Hugging Face hub or a folder.
    depth_anything_model: str = "depth-anything/Depth-Anything-V2-Small-hf"
    # Model of `depth_anything_metric`: an id on the hub or a folder.
    depth_anything_metric_model: str = "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
    # Model of `sam2`: an id on the hub or a folder.
    sam2_model: str = "facebook/sam2.1-hiera-tiny"
    # Model of `edgetam`: an id on the hub or a folder.
    edgetam_model: str = "yonigozlan/EdgeTAM-hf"
    # Weights of torchvision's raft_small for `raft`; default: where torchvision keeps them.
    raft_weights: Path | None = None
    # Where computed priors are kept: auto (LEROBOT_MSDYN_CACHE, else ~/.cache/lerobot_msdyn), off, or a folder.
    cache: str = "auto"


@dataclass
class SceneConfig:
    """How many Gaussians, and from where."""

    # Whether what one episode never shows of a fixed camera's background is taken from the others.
    shared_background: bool = True
    # Upper bound for the static set; one Gaussian per pixel of the fitted image where it suffices.
    static_gaussians: int = 80_000
    # Upper bound for the moving set.
    moving_gaussians: int = 20_000
    # Number of frames from which the moving set is gathered.
    moving_frames: int = 20
    # Pixels along the border of a mask, and beside depth edges, from which no moving point is taken.
    mask_border_px: int = 1
    # Side of the voxels in which the gathered moving points are merged, in pixels of the fitted image.
    moving_voxel_px: float = 0.8
    # Whether what the motion does not explain of a frame is shown as it was recorded, at that frame.
    overlay: bool = True
    # Balls instead of ellipsoids.
    isotropic: bool = False


@dataclass
class FramesPerKnot:
    """Frames from one knot of a motion to the next; between them it is interpolated."""

    # Objects.
    object: int = 1
    # Primitives.
    primitive: int = 2
    # Grains.
    grain: int = 4
    # Particles.
    particle: int = 4


@dataclass
class MotionConfig:
    """The levels of motion."""

    # Coarse to fine: object, then any of primitive, grain, particle; or flat or field alone: other systems' models.
    levels: list[LevelName] = field(default_factory=lambda: ["object", "primitive", "grain"])
    # Rigid parts per moving instance at the object level (a robot arm is one instance with several parts).
    max_parts: int = 6
    # Primitives per rigid part.
    primitives: int = 5
    # Grains per primitive.
    grains: int = 10
    # Particles in the whole scene.
    particles: int = 512
    # Bases of the flat model in the whole scene.
    flat_bases: int = 10
    # Keep a finer level, part by part, only where it predicts tracks better that it was not fitted to.
    gate: bool = True
    # Find the rigid parts and their poses by the recorded depth, colours and outlines; only where depth is metric.
    register: bool = True
    frames_per_knot: FramesPerKnot = field(default_factory=FramesPerKnot)


@dataclass
class LossWeights:
    """Weight of each loss term."""

    # Absolute colour difference.
    rgb: float = 1.0
    # Absolute difference of inverse depth, relative to the mean inverse depth.
    depth: float = 0.1
    # Absolute difference between the drawn share of moving Gaussians and the mask of what moves.
    mask: float = 0.1


@dataclass
class LearningRates:
    """Adam step sizes."""

    # Positions, in units of the scene's look-at distance.
    means: float = 7e-4
    # Logarithm of scales.
    log_scales: float = 5e-3
    # Quaternions.
    quats: float = 1e-3
    # Opacity logits.
    opacity_logits: float = 2e-2
    # Colour coefficients.
    colours: float = 1e-2


@dataclass
class FitConfig:
    """The optimisation."""

    # Largest number of Adam steps; each draws one frame.
    steps: int = 500
    # Widest image that is fitted, in pixels; wider videos are fitted at a reduced size and rendered at their own.
    max_width: int = 320
    # Longest part of a video that is fitted as one scene, in frames; longer videos are cut into equal parts.
    window_frames: int = 300
    # Whether the static set's brightness follows the video (moving shadows, exposure).
    shadows: bool = True
    # Degree of the moving set's spherical harmonics, 0 or 1: how its colours change as it turns.
    sh_degree: int = 1
    # Share of the steps after which the moving set's brightness over time is measured; 1: never.
    moving_gain_from: float = 0.6
    # Frames that are not fitted but tell when to stop; 0: all steps are taken.
    held_out_frames: int = 3
    # Steps without improvement on the held-out frames after which the fit stops.
    patience: int = 150
    weights: LossWeights = field(default_factory=LossWeights)
    learning_rates: LearningRates = field(default_factory=LearningRates)


@dataclass
class PerturbationConfig(draccus.ChoiceRegistry):
    """How the camera of a new episode differs from the recorded one (docs/perturbations.md)."""

    # Whether every frame has a draw of its own, for policies that see single frames; else one per new episode.
    per_frame: bool = False


@PerturbationConfig.register_subclass("orbit")
@dataclass
class OrbitConfig(PerturbationConfig):
    """Turn the camera about the point it looks at, and shift it."""

    # Largest turn to either side, in degrees.
    azimuth_deg: float = 10.0
    # Largest turn up or down, in degrees.
    elevation_deg: float = 5.0
    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = 0.02
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = 0.03


@PerturbationConfig.register_subclass("translation")
@dataclass
class TranslationConfig(PerturbationConfig):
    """Shift the camera without turning it."""

    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = 0.04
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = 0.06


@PerturbationConfig.register_subclass("rotation")
@dataclass
class RotationConfig(PerturbationConfig):
    """Turn the camera in place."""

    # Largest turn to either side, in degrees.
    pan_deg: float = 3.0
    # Largest turn up or down, in degrees.
    tilt_deg: float = 3.0
    # Largest turn about the optical axis, in degrees.
    roll_deg: float = 3.0


@PerturbationConfig.register_subclass("dolly")
@dataclass
class DollyConfig(PerturbationConfig):
    """Move the camera along its optical axis."""

    # Largest way forth or back in metres, where the scale is metric.
    translation_m: float = 0.06
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = 0.1


@PerturbationConfig.register_subclass("focal")
@dataclass
class FocalConfig(PerturbationConfig):
    """Change the focal length."""

    # Largest change: 0.1 makes it up to 1.1 times as long or as short.
    zoom: float = 0.1


@PerturbationConfig.register_subclass("jitter")
@dataclass
class JitterConfig(PerturbationConfig):
    """Shift and turn the camera in place, as if it had been bumped."""

    # Standard deviation of the shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = 0.012
    # The same as a fraction of the look-at distance, where it is not.
    translation_rel: float = 0.02
    # Standard deviation of the turn about each of the camera's axes, in degrees.
    rotation_deg: float = 1.0


@PerturbationConfig.register_subclass("drift")
@dataclass
class DriftConfig(PerturbationConfig):
    """Move the camera smoothly along the episode, about the point it looks at."""

    # Largest turn to either side, in degrees.
    azimuth_deg: float = 6.0
    # Largest turn up or down, in degrees.
    elevation_deg: float = 3.0
    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = 0.02
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = 0.03
    # How often it goes back and forth in an episode.
    cycles: float = 0.5


@PerturbationConfig.register_subclass("poses")
@dataclass
class PosesConfig(PerturbationConfig):
    """Given poses, one after the other over the variants."""

    # Each the first three rows of (new camera from recorded camera), 12 numbers row by row; metres.
    poses: list[list[float]] = field(default_factory=list)


@PerturbationConfig.register_subclass("other_camera")
@dataclass
class OtherCameraConfig(PerturbationConfig):
    """Look from where another calibrated camera stands."""

    # Its name in the calibration file.
    camera: str = ""


@dataclass
class GateConfig:
    """Which new views are kept: each is judged without ground truth, at a few frames (docs/quality.md)."""

    # Whether views are judged; without, all are kept.
    enabled: bool = True
    # Smallest expected peak signal-to-noise ratio of an episode, in dB.
    min_expected_db: float = 14.0
    # Largest median distance from the tracks to the motion, in pixels of the fitted image.
    max_track_px: float = 8.0
    # Largest flicker of what stands still, relative to the video's own.
    max_flicker_ratio: float = 2.0
    # Smallest sharpness (variance of the Laplacian), relative to the video's.
    min_sharpness_ratio: float = 0.1
    # How often a view that is rejected, by the gate or by max_unseen, is drawn again before it is dropped.
    redraws: int = 3


@dataclass
class Recipe:
    """What to reconstruct and what to render; the fields of a recipe file."""

    # Cameras to re-render, by feature key; the others are copied. Default: all but wrist cameras.
    cameras: list[str] | None = None
    # New episodes per source episode.
    variants: int = 2
    # Whether the source episodes are copied into the output as well.
    include_source: bool = True
    # Whether recorded depth of a re-rendered camera is rendered as well; else it is copied, and shows the old view.
    render_depth: bool = True
    # Whether the reconstructed scenes are kept in the output, for training on views of them (docs/scenes.md).
    save_scenes: bool = False
    # Seed of every random choice; together with the episode and the variant it fixes the result.
    seed: int = 0
    # auto, cpu or cuda; auto takes a GPU where everything is there to draw on it (docs/gpu.md).
    device: Device = "auto"
    # Whether a GPU encodes new H.264 and HEVC videos where it can: faster, but not as the source's encoder would.
    nvenc: bool = False
    camera: CameraConfig = field(default_factory=CameraConfig)
    priors: PriorsConfig = field(default_factory=PriorsConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    perturbation: PerturbationConfig = field(default_factory=OrbitConfig)
    # Largest share of a new view that no frame has shown, 0..1; a change that shows more is shrunk, or rejected.
    max_unseen: float = 0.2
    # What stands where nothing was seen: inpaint (continued from what is behind), nearest, or none (black).
    fill: Fill = "inpaint"
    # Cut off what was not seen at the borders: a longer focal length at the same number of pixels.
    crop_to_covered: bool = False
    # Keep masks of what was not seen, per frame, in meta/msdyn/unseen/.
    masks: bool = False
    # Whether cameras that move with the robot may be re-rendered; their pictures are tied to its state.
    allow_moving: bool = False
    gate: GateConfig = field(default_factory=GateConfig)

    @property
    def needs_whole_videos(self) -> bool:
        """Whether a prior is for a whole video: exchange files, and the poses of a moving camera."""
        sources = (self.priors.depth, self.priors.masks, self.priors.tracks, self.camera.poses)
        return self.camera.poses == "sfm" or any(source.endswith(".npz") for source in sources)


@dataclass
class AugmentConfig(Recipe):
    """`python -m lerobot_msdyn.augment`: a recipe and where to read and write."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # Name of the new dataset; default: the source's with _msdyn behind it.
    new_repo_id: str | None = None
    # Exact folder of the new dataset; default: LeRobot's home, or beside --root.
    new_root: Path | None = None
    # Source episodes to use, e.g. '[0,3]'; default: all.
    episodes: list[int] | None = None
    # Processes that work on episodes at once; 0: one per core, as far as memory allows. The result is the same.
    workers: int = 0
    # Report what would be done (episodes, disk, time) and stop.
    dry_run: bool = False
    # Throw away what an unfinished run for the same output has finished, instead of going on with it.
    restart: bool = False
    # Work on a converted copy of a source of version v2.1; the source stays as it is.
    convert: bool = False


@dataclass
class SplitConfig:
    """`python -m lerobot_msdyn.split`: flags for lerobot-train that hold out whole recordings."""

    # Exact folder of the dataset.
    root: Path | None = None
    # Share of each task's recordings that is held out.
    eval_split: float = 0.2


@dataclass
class CarryConfig:
    """`python -m lerobot_msdyn.carry`: meta/msdyn/ for what LeRobot's tools made of other datasets."""

    # Exact folder of the dataset that gets it.
    root: Path | None = None
    # Exact folders of the datasets that it was made from, e.g. '[A, B]'.
    sources: list[Path] = field(default_factory=list)


@dataclass
class PriorsCommandConfig(Recipe):
    """`python -m lerobot_msdyn.priors`: compute the priors alone, and draw them."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # Episodes, e.g. 0 or '[0,3]'; default: all.
    episodes: list[int] | int | None = None
    # Where the results go: OUT/episode_000000/<camera>.npz and OUT/episode_000000.png.
    out: Path = Path()
    # Columns of the contact sheet.
    columns: int = 6


@dataclass
class EvaluateConfig(Recipe):
    """`python -m lerobot_msdyn.evaluate nvs`: fit one episode, render its held-out cameras."""

    # Folder with dataset/ (or dataset_depth/) and gt/, see docs/evaluate.md.
    scene_folder: Path = Path()
    # Where the rendered views go: OUT/<camera>/rgb_%04d.png; and OUT/scores.json.
    out: Path = Path()
    # recorded, none, or an .npz file with depth [t,h,w].
    depth: str = "recorded"


@dataclass
class DycheckConfig(Recipe):
    """`python -m lerobot_msdyn.evaluate dycheck`: fit a DyCheck iPhone sequence, score its validation views."""

    # Folder of the sequence, with rgb/, splits/ and so on, see docs/evaluate.md.
    root: Path = Path()
    # Where the rendered views go: OUT/rgb/<id>.png; and OUT/scores.json.
    out: Path = Path()
    # som (1x pictures, Shape of Motion's processed package) or dycheck (2x pictures, cameras of the sequence).
    protocol: Protocol = "som"


@dataclass
class HeldoutCameraConfig(Recipe):
    """`python -m lerobot_msdyn.evaluate heldout-camera`: fit one camera of a rig, score what another one saw."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # The episode.
    episode: int = 0
    # The camera that is fitted, by feature key or its last part.
    train_camera: str = ""
    # The camera that is compared with; it is not fitted.
    test_camera: str = ""
    # Where the rendered views go: OUT/rgb_%04d.png; and OUT/scores.json.
    out: Path = Path()


@dataclass
class ViewerConfig(Recipe):
    """`python -m lerobot_msdyn.viewer`: look at an episode, its scene and its new views in Rerun."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # The episode to show.
    episode: int = 0
    # Output folder of `augment --save_scenes true`; without it the episode is fitted first.
    scenes: Path | None = None
    # A .rrd file to write instead of opening a window.
    save: Path | None = None


@dataclass
class MixedViewsConfig:
    """`lerobot_msdyn.training`: which samples are seen from elsewhere while a policy is trained (docs/training.md)."""

    # Output folder of `augment --save_scenes true`.
    scenes: Path = Path()
    # Share of the samples that are seen from elsewhere.
    probability: float = 0.5
    # A recipe, by file or name, whose perturbation is drawn; default: the one of the run that saved the scenes.
    perturbation: str | None = None
    # Seed of every random choice; together with the epoch and the sample's index it fixes the result.
    seed: int = 0
    # Memory for the scenes that are kept loaded, in MB, in each data loading worker.
    memory_mb: float = 1024.0


def problems(config: object, prefix: str = "") -> list[str]:
    """One line per value that is out of range, over all nested fields; `config` is any of the classes here."""
    lines = []
    for name, known in _PROVIDERS.get(type(config).__name__, {}).items():
        value = getattr(config, name)
        if value not in known and not value.endswith(".npz"):
            lines.append(f"{prefix}{name} is {value!r}; expected {', '.join(known)} or a file FILE.npz")
    for name, low, high in _RANGES.get(type(config).__name__, ()):
        value = getattr(config, name)
        if not low <= value <= high:
            lines.append(f"{prefix}{name} is {value}; expected a value from {low} to {high}")
    if isinstance(config, MotionConfig) and not _is_hierarchy(config.levels):
        lines.append(
            f"{prefix}levels is [{', '.join(config.levels)}]; expected [object], then any of primitive, grain (after "
            "primitive) and particle in this order; or [flat] or [field] alone"
        )
    lines += [prefix + line for line in _perturbation_problems(config)]
    for item in fields(config):  # type: ignore[arg-type]
        value = getattr(config, item.name)
        if is_dataclass(value):
            lines += problems(value, f"{prefix}{item.name}.")
    return lines


def _perturbation_problems(config: object) -> list[str]:
    lines = []
    if isinstance(config, PosesConfig):
        if not config.poses:
            lines.append("poses is empty; expected at least one pose of 12 numbers")
        lines += [
            f"poses[{number}] is no rigid motion; expected 12 numbers, three rows of a rotation and a shift in metres"
            for number, pose in enumerate(config.poses)
            if not _is_rigid(pose)
        ]
    if isinstance(config, OtherCameraConfig) and not config.camera:
        lines.append("camera is empty; expected the name of a camera in the calibration file")
    if isinstance(config, DriftConfig | PosesConfig | OtherCameraConfig) and config.per_frame:
        lines.append("per_frame is true; expected false for this type, which draws nothing per frame")
    return lines


def _is_rigid(pose: list[float]) -> bool:
    """Whether 12 numbers, row by row, are a rotation and a shift."""
    if len(pose) != 12:
        return False
    x, y, z = pose[0:3], pose[4:7], pose[8:11]
    products = [sum(p * q for p, q in zip(a, b, strict=True)) for a in (x, y, z) for b in (x, y, z)]
    identity = [1, 0, 0, 0, 1, 0, 0, 0, 1]
    crossed = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    right_handed = sum(p * q for p, q in zip(crossed, z, strict=True)) > 0
    return right_handed and all(abs(p - q) < 1e-3 for p, q in zip(products, identity, strict=True))


def _is_hierarchy(levels: list[LevelName]) -> bool:
    """Whether levels go from coarse to fine, each with what carries it."""
    order = ("object", "primitive", "grain", "particle")
    if levels in (["flat"], ["field"]):
        return True
    fine = list(levels[1:])
    ascending = fine == [name for name in order[1:] if name in fine]
    return levels[:1] == ["object"] and ascending and ("grain" not in fine or "primitive" in fine)


# Class -> field -> what it may be, besides an exchange file.
_PROVIDERS: dict[str, dict[str, tuple[str, ...]]] = {
    "CameraConfig": {"poses": ("auto", "fixed", "sfm")},
    "PriorsConfig": {
        "depth": ("auto", "recorded", "plane", "depth_anything", "depth_anything_metric", "stereo"),
        "masks": ("auto", "change", "sam2", "edgetam"),
        "tracks": ("auto", "flow", "raft"),
    },
}
_ANY = float("inf")
_RECIPE_RANGES = (("variants", 1, 1000), ("max_unseen", 0, 1))
_SHIFT = (("translation_m", 0, 10), ("translation_rel", 0, 0.9))
# Class -> (field, smallest, largest value).
_RANGES: dict[str, tuple[tuple[str, float, float], ...]] = {
    "Recipe": _RECIPE_RANGES,
    "AugmentConfig": _RECIPE_RANGES,
    "EvaluateConfig": _RECIPE_RANGES,
    "DycheckConfig": _RECIPE_RANGES,
    "HeldoutCameraConfig": (*_RECIPE_RANGES, ("episode", 0, 1_000_000_000)),
    "ViewerConfig": _RECIPE_RANGES,
    "PriorsCommandConfig": (*_RECIPE_RANGES, ("columns", 1, 100)),
    "CameraConfig": (("horizontal_fov_deg", 5, 170), ("height_m", 0.01, 100), ("tilt_deg", 1, 90)),
    "SceneConfig": (
        ("static_gaussians", 100, 10_000_000),
        ("moving_gaussians", 0, 10_000_000),
        ("moving_frames", 1, 100_000),
        ("mask_border_px", 0, 100),
        ("moving_voxel_px", 0.05, 100),
    ),
    "MotionConfig": (
        ("max_parts", 1, 64),
        ("primitives", 1, 1000),
        ("grains", 1, 1000),
        ("particles", 1, 100_000),
        ("flat_bases", 1, 10_000),
    ),
    "FramesPerKnot": tuple((name, 1, 1000) for name in ("object", "primitive", "grain", "particle")),
    "LossWeights": (("rgb", 0, _ANY), ("depth", 0, _ANY), ("mask", 0, _ANY)),
    "LearningRates": tuple((name, 0, 1) for name in ("means", "log_scales", "quats", "opacity_logits", "colours")),
    "FitConfig": (
        ("steps", 0, 1_000_000),
        ("max_width", 16, 8192),
        ("window_frames", 1, 100_000),
        ("sh_degree", 0, 1),
        ("moving_gain_from", 0, 1),
        ("held_out_frames", 0, 1000),
        ("patience", 1, 1_000_000),
    ),
    "MixedViewsConfig": (("probability", 0, 1), ("seed", 0, 2**32 - 1), ("memory_mb", 0, _ANY)),
    "GateConfig": (
        ("min_expected_db", 0, 60),
        ("max_track_px", 0, _ANY),
        ("max_flicker_ratio", 0, _ANY),
        ("min_sharpness_ratio", 0, _ANY),
        ("redraws", 0, 100),
    ),
    "OrbitConfig": (("azimuth_deg", 0, 90), ("elevation_deg", 0, 60), *_SHIFT),
    "TranslationConfig": _SHIFT,
    "RotationConfig": tuple((name, 0, 45) for name in ("pan_deg", "tilt_deg", "roll_deg")),
    "DollyConfig": _SHIFT,
    "FocalConfig": (("zoom", 0, 1),),
    "JitterConfig": (*_SHIFT, ("rotation_deg", 0, 45)),
    "DriftConfig": (("azimuth_deg", 0, 90), ("elevation_deg", 0, 60), *_SHIFT, ("cycles", 0, 100)),
}
