"""Every field that a recipe or a flag can set, with its default, unit and meaning (the comments are the help texts).

No torch here, so that `--help` answers at once. Recipes are YAML files with the fields of `Recipe`; any field can be
overridden by a flag of the same dotted name, e.g. `--fit.steps 1000`.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import draccus

from lerobot_msdyn.core.fields import AUTO, FILE, INFINITY, between, one_of
from lerobot_msdyn.core.registries import CAMERAS, DEPTH, MASKS, TRACKS
from lerobot_msdyn.core.registry import Registry

# Named: draccus finds the comment above a field only where its annotation holds no quotes.
Device = Literal["auto", "cpu", "cuda"]
Fill = Literal["inpaint", "nearest", "none"]
LevelName = Literal["object", "primitive", "grain", "particle", "flat", "field"]


@dataclass
class CameraConfig:
    """Where the cameras' geometry comes from."""

    # JSON file with K (and R, t) of each camera, see docs/calibration.md; without it the camera is taken as fixed.
    calibration: Path | None = None
    # auto (the calibration, else fixed), fixed, sfm (pycolmap, for a moving camera), or an .npz file with K and w2c.
    poses: str = one_of(AUTO, (AUTO,), registry=CAMERAS)
    # Horizontal field of view in degrees, used where no calibration names the camera.
    horizontal_fov_deg: float = between(60.0, 5, 170)
    # Look for the field of view at which rigid things keep their size; needs depth other than the plane's.
    fov_search: bool = False
    # Height of the camera above the table in metres, used where no depth is recorded.
    height_m: float = between(0.5, 0.01, 100)
    # Downward tilt of the camera in degrees, used where no depth is recorded.
    tilt_deg: float = between(35.0, 1, 90)

    @property
    def needs_whole_videos(self) -> bool:
        """Whether the poses are found for a whole video: it cannot be fitted part by part."""
        return _needs_whole_videos(self.poses, CAMERAS)


@dataclass
class PriorsConfig:
    """What is known about a video before the fit: each by a provider (docs/priors.md), yours too (--plugins)."""

    # auto (recorded, else a learned model that is on this machine, else stereo, else plane), recorded, plane,
    # depth_anything, depth_anything_metric, stereo (two or more calibrated cameras), or an .npz file.
    depth: str = one_of(AUTO, (AUTO,), registry=DEPTH)
    # auto (a learned model that is on this machine, else change), change, sam2, edgetam, or an .npz file.
    masks: str = one_of(AUTO, (AUTO,), registry=MASKS)
    # auto (raft if its weights are on this machine, else flow), flow, raft, or an .npz file.
    tracks: str = one_of(AUTO, (AUTO,), registry=TRACKS)
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

    @property
    def needs_whole_videos(self) -> bool:
        """Whether one of them is found for a whole video: it cannot be fitted part by part."""
        chosen = ((self.depth, DEPTH), (self.masks, MASKS), (self.tracks, TRACKS))
        return any(_needs_whole_videos(name, registry) for name, registry in chosen)

    @property
    def reads_recorded_depth(self) -> bool:
        """Whether recorded depth can be of use, so that its videos have to be decoded."""
        return self.depth not in DEPTH or bool(DEPTH.get(self.depth).reads_recorded_depth)


@dataclass
class SceneConfig:
    """How many Gaussians, and from where."""

    # Whether what one episode never shows of a fixed camera's background is taken from the others.
    shared_background: bool = True
    # Upper bound for the static set; one Gaussian per pixel of the fitted image where it suffices.
    static_gaussians: int = between(80_000, 100, 10_000_000)
    # Upper bound for the moving set.
    moving_gaussians: int = between(20_000, 0, 10_000_000)
    # Number of frames from which the moving set is gathered.
    moving_frames: int = between(20, 1, 100_000)
    # Pixels along the border of a mask, and beside depth edges, from which no moving point is taken.
    mask_border_px: int = between(1, 0, 100)
    # Side of the voxels in which the gathered moving points are merged, in pixels of the fitted image.
    moving_voxel_px: float = between(0.8, 0.05, 100)
    # Whether what the motion does not explain of a frame is shown as it was recorded, at that frame.
    overlay: bool = True
    # Balls instead of ellipsoids.
    isotropic: bool = False


@dataclass
class FramesPerKnot:
    """Frames from one knot of a motion to the next; between them it is interpolated."""

    # Objects.
    object: int = between(1, 1, 1000)
    # Primitives.
    primitive: int = between(2, 1, 1000)
    # Grains.
    grain: int = between(4, 1, 1000)
    # Particles.
    particle: int = between(4, 1, 1000)


@dataclass
class MotionConfig:
    """The levels of motion."""

    # Coarse to fine: object, then any of primitive, grain, particle; or flat or field alone: other systems' models.
    levels: list[LevelName] = field(default_factory=lambda: ["object", "primitive", "grain"])
    # Rigid parts per moving instance at the object level (a robot arm is one instance with several parts).
    max_parts: int = between(6, 1, 64)
    # Primitives per rigid part.
    primitives: int = between(5, 1, 1000)
    # Grains per primitive.
    grains: int = between(10, 1, 1000)
    # Particles in the whole scene.
    particles: int = between(512, 1, 100_000)
    # Bases of the flat model in the whole scene.
    flat_bases: int = between(10, 1, 10_000)
    # Keep a finer level, part by part, only where it predicts tracks better that it was not fitted to.
    gate: bool = True
    # Find the rigid parts and their poses by the recorded depth, colours and outlines; only where depth is metric.
    register: bool = True
    frames_per_knot: FramesPerKnot = field(default_factory=FramesPerKnot)

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        if _is_hierarchy(self.levels):
            return []
        return [
            f"levels is [{', '.join(self.levels)}]; expected [object], then any of primitive, grain (after "
            "primitive) and particle in this order; or [flat] or [field] alone"
        ]


@dataclass
class LossWeights:
    """Weight of each loss term."""

    # Absolute colour difference.
    rgb: float = between(1.0, 0, INFINITY)
    # Absolute difference of inverse depth, relative to the mean inverse depth.
    depth: float = between(0.1, 0, INFINITY)
    # Absolute difference between the drawn share of moving Gaussians and the mask of what moves.
    mask: float = between(0.1, 0, INFINITY)


@dataclass
class LearningRates:
    """Adam step sizes."""

    # Positions, in units of the scene's look-at distance.
    means: float = between(7e-4, 0, 1)
    # Logarithm of scales.
    log_scales: float = between(5e-3, 0, 1)
    # Quaternions.
    quats: float = between(1e-3, 0, 1)
    # Opacity logits.
    opacity_logits: float = between(2e-2, 0, 1)
    # Colour coefficients.
    colours: float = between(1e-2, 0, 1)


@dataclass
class FitConfig:
    """The optimisation."""

    # Largest number of Adam steps; each draws one frame.
    steps: int = between(500, 0, 1_000_000)
    # Widest image that is fitted, in pixels; wider videos are fitted at a reduced size and rendered at their own.
    max_width: int = between(320, 16, 8192)
    # Longest part of a video that is fitted as one scene, in frames; longer videos are cut into equal parts.
    window_frames: int = between(300, 1, 100_000)
    # Whether the static set's brightness follows the video (moving shadows, exposure).
    shadows: bool = True
    # Degree of the moving set's spherical harmonics, 0 or 1: how its colours change as it turns.
    sh_degree: int = between(1, 0, 1)
    # Share of the steps after which the moving set's brightness over time is measured; 1: never.
    moving_gain_from: float = between(0.6, 0, 1)
    # Frames that are not fitted but tell when to stop; 0: all steps are taken.
    held_out_frames: int = between(3, 0, 1000)
    # Steps without improvement on the held-out frames after which the fit stops.
    patience: int = between(150, 1, 1_000_000)
    weights: LossWeights = field(default_factory=LossWeights)
    learning_rates: LearningRates = field(default_factory=LearningRates)


@dataclass
class PerturbationConfig(draccus.ChoiceRegistry):
    """How the camera of a new episode differs from the recorded one (docs/perturbations.md)."""

    # Whether every frame has a draw of its own, for policies that see single frames; else one per new episode.
    per_frame: bool = False

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        return []


@PerturbationConfig.register_subclass("orbit")
@dataclass
class OrbitConfig(PerturbationConfig):
    """Turn the camera about the point it looks at, and shift it."""

    # Largest turn to either side, in degrees.
    azimuth_deg: float = between(10.0, 0, 90)
    # Largest turn up or down, in degrees.
    elevation_deg: float = between(5.0, 0, 60)
    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = between(0.02, 0, 10)
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = between(0.03, 0, 0.9)


@PerturbationConfig.register_subclass("translation")
@dataclass
class TranslationConfig(PerturbationConfig):
    """Shift the camera without turning it."""

    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = between(0.04, 0, 10)
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = between(0.06, 0, 0.9)


@PerturbationConfig.register_subclass("rotation")
@dataclass
class RotationConfig(PerturbationConfig):
    """Turn the camera in place."""

    # Largest turn to either side, in degrees.
    pan_deg: float = between(3.0, 0, 45)
    # Largest turn up or down, in degrees.
    tilt_deg: float = between(3.0, 0, 45)
    # Largest turn about the optical axis, in degrees.
    roll_deg: float = between(3.0, 0, 45)


@PerturbationConfig.register_subclass("dolly")
@dataclass
class DollyConfig(PerturbationConfig):
    """Move the camera along its optical axis."""

    # Largest way forth or back in metres, where the scale is metric.
    translation_m: float = between(0.06, 0, 10)
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = between(0.1, 0, 0.9)


@PerturbationConfig.register_subclass("focal")
@dataclass
class FocalConfig(PerturbationConfig):
    """Change the focal length."""

    # Largest change: 0.1 makes it up to 1.1 times as long or as short.
    zoom: float = between(0.1, 0, 1)


@PerturbationConfig.register_subclass("jitter")
@dataclass
class JitterConfig(PerturbationConfig):
    """Shift and turn the camera in place, as if it had been bumped."""

    # Standard deviation of the shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = between(0.012, 0, 10)
    # The same as a fraction of the look-at distance, where it is not.
    translation_rel: float = between(0.02, 0, 0.9)
    # Standard deviation of the turn about each of the camera's axes, in degrees.
    rotation_deg: float = between(1.0, 0, 45)


@PerturbationConfig.register_subclass("drift")
@dataclass
class DriftConfig(PerturbationConfig):
    """Move the camera smoothly along the episode, about the point it looks at."""

    # Largest turn to either side, in degrees.
    azimuth_deg: float = between(6.0, 0, 90)
    # Largest turn up or down, in degrees.
    elevation_deg: float = between(3.0, 0, 60)
    # Largest shift along each of the camera's axes in metres, where the scale is metric.
    translation_m: float = between(0.02, 0, 10)
    # The same as a fraction of the distance to the look-at point, where it is not.
    translation_rel: float = between(0.03, 0, 0.9)
    # How often it goes back and forth in an episode.
    cycles: float = between(0.5, 0, 100)

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        return _no_draw_per_frame(self)


@PerturbationConfig.register_subclass("poses")
@dataclass
class PosesConfig(PerturbationConfig):
    """Given poses, one after the other over the variants."""

    # Each the first three rows of (new camera from recorded camera), 12 numbers row by row; metres.
    poses: list[list[float]] = field(default_factory=list)

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        none = [] if self.poses else ["poses is empty; expected at least one pose of 12 numbers"]
        bad = [
            f"poses[{number}] is no rigid motion; expected 12 numbers, three rows of a rotation and a shift in metres"
            for number, pose in enumerate(self.poses)
            if not _is_rigid(pose)
        ]
        return [*none, *bad, *_no_draw_per_frame(self)]


@PerturbationConfig.register_subclass("other_camera")
@dataclass
class OtherCameraConfig(PerturbationConfig):
    """Look from where another calibrated camera stands."""

    # Its name in the calibration file.
    camera: str = ""

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        unnamed = [] if self.camera else ["camera is empty; expected the name of a camera in the calibration file"]
        return unnamed + _no_draw_per_frame(self)


@dataclass
class GateConfig:
    """Which new views are kept: each is judged without ground truth, at a few frames (docs/quality.md)."""

    # Whether views are judged; without, all are kept.
    enabled: bool = True
    # Smallest expected peak signal-to-noise ratio of an episode, in dB.
    min_expected_db: float = between(14.0, 0, 60)
    # Largest median distance from the tracks to the motion, in pixels of the fitted image.
    max_track_px: float = between(8.0, 0, INFINITY)
    # Largest flicker of what stands still, relative to the video's own.
    max_flicker_ratio: float = between(2.0, 0, INFINITY)
    # Smallest sharpness (variance of the Laplacian), relative to the video's.
    min_sharpness_ratio: float = between(0.1, 0, INFINITY)
    # How often a view that is rejected, by the gate or by max_unseen, is drawn again before it is dropped.
    redraws: int = between(3, 0, 100)


@dataclass
class Recipe:
    """What to reconstruct and what to render; the fields of a recipe file."""

    # Cameras to re-render, by feature key; the others are copied. Default: all but wrist cameras.
    cameras: list[str] | None = None
    # New episodes per source episode.
    variants: int = between(2, 1, 1000)
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
    max_unseen: float = between(0.2, 0, 1)
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
        return self.priors.needs_whole_videos or self.camera.needs_whole_videos


def _needs_whole_videos(name: str, registry: Registry) -> bool:
    return name.endswith(FILE) or (name in registry and bool(registry.get(name).needs_whole_videos))


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


def _no_draw_per_frame(config: PerturbationConfig) -> list[str]:
    if not config.per_frame:
        return []
    return ["per_frame is true; expected false for this type, which draws nothing per frame"]


def _is_hierarchy(levels: list[LevelName]) -> bool:
    """Whether levels go from coarse to fine, each with what carries it."""
    order = ("object", "primitive", "grain", "particle")
    if levels in (["flat"], ["field"]):
        return True
    fine = list(levels[1:])
    ascending = fine == [name for name in order[1:] if name in fine]
    return levels[:1] == ["object"] and ascending and ("grain" not in fine or "primitive" in fine)
