"""Every field that a recipe or a flag can set, with its default, unit and meaning (the comments are the help texts).

No torch here, so that `--help` answers at once. Recipes are YAML files with the fields of `Recipe`; any field can be
overridden by a flag of the same dotted name, e.g. `--fit.steps 1000`.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import draccus

from lerobot_msdyn.core.errors import ConfigError, one_line
from lerobot_msdyn.core.fields import (
    AUTO,
    FILE,
    INFINITY,
    MAX_SEED,
    MAX_WEIGHT,
    PARAMETER,
    between,
    numbers_of,
    one_of,
    problems,
)
from lerobot_msdyn.core.perturbation import Perturbation
from lerobot_msdyn.core.registries import CAMERAS, DEPTH, LOSSES, MASKS, MOTION_LEVELS, TRACKS
from lerobot_msdyn.core.registry import Registry

# Named: draccus finds the comment above a field only where its annotation holds no quotes.
Device = Literal["auto", "cpu", "cuda"]
Fill = Literal["inpaint", "nearest", "blur", "noise", "none"]
POSE_ROTATIONS = ("matrix", "quaternion_xyzw", "quaternion_wxyz", "euler_xyz", "rotation_vector")
FIXED = "fixed"  # provider of the camera as the dataset and its calibration have it
_LEVELS = ["object", "primitive", "grain"]
# Motion levels of other systems, which are not the package's own -> the plugin that registers each.
RIVAL_LEVELS = {"flat": "benchmarks/rivals/flat.py", "field": "benchmarks/rivals/field.py"}
# Fields of earlier versions -> what to do instead; recipes that an output keeps name all fields.
FORMER_FIELDS = {
    "motion.flat_bases": f"leave it out, or for the flat model add --plugins {RIVAL_LEVELS['flat']} and set "
    "motion.settings.flat.bases"
}


@dataclass
class CameraConfig:
    """Where the cameras' geometry comes from."""

    # JSON file with K (and R, t) of each camera, see docs/calibration.md; without it the camera is taken as fixed.
    calibration: Path | None = None
    # Whether the robot's joints tell where cameras without a calibration stand, if its description is on this machine.
    by_robot: bool = True
    # auto (pose_columns, else the calibration, else fixed), fixed, sfm (pycolmap, for a moving camera), or an .npz file
    # with K and w2c.
    poses: str = one_of(AUTO, (AUTO,), registry=CAMERAS)
    # Columns that hold a camera's pose in every frame: {CAMERA: COLUMN}, see docs/calibration.md.
    pose_columns: dict[str, str] = field(default_factory=dict)
    # What they map: c2w (camera to world, which is the camera's pose) or w2c.
    pose_maps: str = one_of("c2w", ("c2w", "w2c"))
    # Axes of the camera in them: opencv (x right, y down, z forward) or opengl (y up, z backward; ARKit, Blender).
    pose_axes: str = one_of("opencv", ("opencv", "opengl"))
    # How they say a rotation: auto (told by the column's shape and names), matrix, quaternion_xyzw, quaternion_wxyz,
    # euler_xyz (rad, about the fixed axes x, y, z in turn) or rotation_vector (rad).
    pose_rotation: str = one_of(AUTO, (AUTO, *POSE_ROTATIONS))
    # Whether the poses of a camera that moves are refined: each frame is laid over what stands still.
    refine_poses: bool = True
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

    def known_before(self, key: str) -> bool:
        """Whether a camera's poses are known without its video: by a column, files, or a provider that says so."""
        name = self.poses.partition(PARAMETER)[0]
        if self.poses in (AUTO, FIXED):
            return self.pose_column(key) is not None
        return self.poses.endswith(FILE) or (name in CAMERAS and bool(CAMERAS.get(name).known_before))

    def pose_column(self, key: str) -> str | None:
        """The column that holds the poses of the camera with this feature key; None: none does."""
        return self.pose_columns.get(key, self.pose_columns.get(key.rsplit(".", 1)[-1]))


@dataclass
class RobotConfig:
    """The robot that the cameras film (docs/robots.md)."""

    # Its description (URDF), with the meshes where it names them.
    urdf: Path | None = None
    # Its name: so101, or one of the package robot_descriptions; default: by the dataset's robot_type.
    name: str = ""
    # Names in observation.state -> joints of the description, where they differ.
    joints: dict[str, str] = field(default_factory=dict)
    # Of the state: auto (told from its values), degrees, radians, normalised (-100..100 of each range) or ticks.
    units: str = one_of("auto", ("auto", "degrees", "radians", "normalised", "ticks"))


@dataclass
class PriorsConfig:
    """What is known about a video before the fit: each by a provider (docs/priors.md), yours too (--plugins)."""

    # auto (recorded, else a learned model that is on this machine, else stereo, parallax or plane), recorded, plane,
    # depth_anything, depth_anything_metric, onnx:FILE.onnx, stereo (two or more calibrated cameras), parallax (a camera
    # that moves, with poses), or an .npz file.
    depth: str = one_of(AUTO, (AUTO,), registry=DEPTH)
    # auto (a learned model that is on this machine, else change), change, sam2, edgetam, onnx:FOLDER, or an .npz file.
    masks: str = one_of(AUTO, (AUTO,), registry=MASKS)
    # auto (raft if its weights are on this machine, else flow), flow, raft, or an .npz file.
    tracks: str = one_of(AUTO, (AUTO,), registry=TRACKS)
    # Model of `depth_anything`: an id on the Hugging Face hub or a folder.
    depth_anything_model: str = "depth-anything/Depth-Anything-V2-Small-hf"
    # Model of `depth_anything_metric`: an id on the hub or a folder.
    depth_anything_metric_model: str = "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
    # Of the network of `onnx:FILE.onnx`: what it takes and gives, where neither FILE.yaml beside it nor its name tells,
    # e.g. --priors.onnx.kind metric (docs/priors.md).
    onnx: dict[str, Any] = field(default_factory=dict)
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
        name = self.depth.partition(PARAMETER)[0]
        return name not in DEPTH or bool(DEPTH.get(name).reads_recorded_depth)


@dataclass
class SceneConfig:
    """How many Gaussians, and from where."""

    # Whether what one episode never shows of what stands still is taken from the others: of a fixed camera, and of one
    # that moves where their poses share a world.
    shared_background: bool = True
    # Upper bound for the static set (before a camera that moves: for each key view); one Gaussian per pixel of the
    # fitted image where it suffices.
    static_gaussians: int = between(80_000, 100, 10_000_000)
    # Upper bound for the moving set.
    moving_gaussians: int = between(20_000, 0, 10_000_000)
    # Number of frames from which the moving set is gathered.
    moving_frames: int = between(20, 1, 100_000)
    # Pixels (of pictures 320 wide) along masks' borders, and beside depth edges, from which no moving point is taken.
    mask_border_px: int = between(1, 0, 100)
    # Side of the voxels in which the gathered moving points are merged, in pixels of the fitted image.
    moving_voxel_px: float = between(0.8, 0.05, 100)
    # Frames to either side in which what the motion does not explain of a frame is shown as well, carried by the motion
    # of what is nearest, where they agree; 0: in none.
    short_lived: int = between(2, 0, 100)
    # Whether what is not explained then is shown as it was recorded, at its own frame.
    overlay: bool = True
    # Balls instead of ellipsoids.
    isotropic: bool = False


@dataclass
class MotionConfig:
    """The levels of motion."""

    # Coarse to fine: object, then any of primitive, grain (after primitive) and particle in this order, and levels of
    # your own that --plugins registers (docs/extending.md).
    levels: list[str] = field(default_factory=lambda: list(_LEVELS))
    # Rigid parts per moving instance at the object level (a robot arm is one instance with several parts).
    max_parts: int = between(6, 1, 64)
    # Parts that a Gaussian follows at the object level, by their nearness; 1: its own alone.
    blend_parts: int = between(1, 1, 64)
    # Distance at which a neighbouring part counts 0.6 of a Gaussian's own, in units of the parts' usual reach.
    blend_reach: float = between(0.1, 0.001, 100)
    # Primitives per rigid part.
    primitives: int = between(5, 1, 1000)
    # Grains per primitive.
    grains: int = between(10, 1, 1000)
    # Particles per rigid part.
    particles: int = between(512, 1, 100_000)
    # Keep a finer level, part by part, only where it predicts tracks better that it was not fitted to.
    gate: bool = True
    # Find the rigid parts and their poses by the recorded depth, colours and outlines; only where depth is metric.
    register: bool = True
    # By level: frames from one knot of its motion to the next; between them it is interpolated. Without: object 1,
    # primitive 2, grain 4, particle 4.
    frames_per_knot: dict[str, int] = numbers_of({}, 1, 1000, registry=MOTION_LEVELS)
    # By level: the settings of levels of your own.
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)

    def settings_of[S](self, level: str, kind: type[S]) -> S:
        """A level's own settings: a dataclass of that kind with what `settings` holds for the level.

        Raises:
            ConfigError: it holds something that the dataclass does not have, or of another type.
        """
        try:
            return draccus.decode(kind, self.settings.get(level, {}))
        except draccus.utils.DraccusException as error:
            raise ConfigError(f"settings.{level}: {one_line(error)}") from error

    def problems(self) -> list[str]:
        """What is wrong between fields."""
        known, listed = MOTION_LEVELS.names(), f"levels is [{', '.join(self.levels)}]"
        lines = [f"{listed}; {_unknown_level(name, known)}" for name in self.levels if name not in known]
        lines += [f"settings.{name}: {_unknown_level(name, known)}" for name in self.settings if name not in known]
        if lines or (self.levels == _LEVELS and not self.settings):
            return lines  # the default is right: nothing needs to be imported to tell
        return [*self._order_problems(listed), *self._settings_problems()]

    def _order_problems(self, listed: str) -> list[str]:
        if not self.levels:
            return [f"{listed}; expected at least one level, such as object"]
        for coarser, name in zip(["", *self.levels], self.levels, strict=False):
            after = MOTION_LEVELS.get(name).after
            if coarser and coarser not in after and name not in MOTION_LEVELS.get(coarser).before:
                return [f"{listed}; expected {name} {_place(after)}, not after {coarser}"]
            if not coarser and after:
                return [f"{listed}; expected {name} {_place(after)}"]
        return []

    def _settings_problems(self) -> list[str]:
        lines = []
        for name in self.settings:
            kind = MOTION_LEVELS.get(name).settings
            if kind is None:
                lines.append(f"settings.{name}: level {name} has no settings of its own")
                continue
            try:
                lines += problems(self.settings_of(name, kind), f"settings.{name}.")
            except ConfigError as error:
                lines.append(str(error))
        return lines


def _place(after: tuple[str, ...]) -> str:
    return f"right after {' or '.join(after)}" if after else "in the first place"


def _unknown_level(name: str, known: list[str]) -> str:
    file = RIVAL_LEVELS.get(name, "FILE.py, if it is your own")
    return f"expected some of {', '.join(known)}; {name} is none of them: add --plugins {file}"


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
    # Turns of motion bases (the first two columns of their rotations), where they are learned.
    basis_turns: float = between(1e-3, 0, 1)
    # Shifts of motion bases, in units of the scene's look-at distance, likewise.
    basis_shifts: float = between(1e-4, 0, 1)
    # Logits of the weights by which Gaussians follow bases, likewise.
    motion_weights: float = between(1e-2, 0, 1)
    # Turns of a moving camera's poses in radians, where they are learned.
    pose_turns: float = between(3e-4, 0, 1)
    # Shifts of these poses, in units of the scene's look-at distance, likewise.
    pose_shifts: float = between(3e-4, 0, 1)


@dataclass
class LearnConfig:
    """What is learned with the Gaussians beside them; without, it stays as it was estimated."""

    # Whether the bases of all levels are.
    bases: bool = False
    # Whether the weights by which Gaussians follow them are.
    weights: bool = False
    # Whether the poses of a camera that moves are, a small turn and shift per frame, from the first step on.
    poses: bool = True
    # Share of the steps after which bases and weights begin.
    begin: float = between(0.3, 0, 1)
    # The better the tracks agree with a basis, the slower it is learned: at half the rate where they miss it by so many
    # pixels (median, of pictures 320 wide); 0: all bases at the full rate, also those that no track follows.
    sure_px: float = between(0.0, 0, INFINITY)

    @property
    def motion(self) -> bool:
        """Whether anything of the motion is."""
        return self.bases or self.weights


@dataclass
class DensityConfig:
    """Adaptive density control of the static and the moving set (3DGS, Kerbl et al. 2023, section 5.2)."""

    # Whether Gaussians are cloned, split and pruned during the fit.
    enabled: bool = False
    # Share of the steps at which it begins ...
    begin: float = between(0.05, 0, 1)
    # ... and ends.
    end: float = between(0.6, 0, 1)
    # Steps from one round to the next.
    every: int = between(50, 1, 1_000_000)
    # Mean gradient of a Gaussian's place in the image, in halves of the picture, beyond which it is cloned or split.
    gradient: float = between(2e-4, 0, INFINITY)
    # Largest standard deviation of those that are cloned, in units of the look-at distance; larger ones are split.
    clone_size: float = between(0.005, 0, INFINITY)
    # Opacity below which a Gaussian is pruned.
    min_opacity: float = between(0.05, 0, 1)
    # Largest standard deviation, in units of the look-at distance, beyond which a Gaussian is pruned.
    max_size: float = between(0.1, 0, INFINITY)
    # Steps from one reset of the opacities to the next; 0: never.
    reset_every: int = between(3000, 0, 1_000_000)
    # Largest number of Gaussians of either set, relative to what it began with.
    growth: float = between(2.0, 1, 1000)


@dataclass
class FitConfig:
    """The optimisation."""

    # Largest number of Adam steps; each draws one frame.
    steps: int = between(500, 0, 1_000_000)
    # Before a fixed camera without measured depth every so many-th step looks at a whole picture, the others only near
    # what moves; 1: all.
    whole_every: int = between(16, 1, 1_000_000)
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
    # Weight of each loss term; those that are not named, or have 0, are not used. rgb: absolute colour difference;
    # depth: absolute difference of inverse depth, relative to its mean; mask: absolute difference between the rendered
    # share of moving Gaussians and the mask of what moves; ssim: 1 - structural similarity; track: distance between
    # where points are carried and where they were tracked; rigidity: change of neighbours' offsets between two frames;
    # or a user's own (--fit.weights.NAME).
    weights: dict[str, float] = numbers_of({"rgb": 1.0, "depth": 0.1, "mask": 0.1}, 0, MAX_WEIGHT, registry=LOSSES)
    learning_rates: LearningRates = field(default_factory=LearningRates)
    learn: LearnConfig = field(default_factory=LearnConfig)
    density: DensityConfig = field(default_factory=DensityConfig)


@dataclass
class GateConfig:
    """Which new views are kept: each is judged without ground truth, at a few frames (docs/views.md)."""

    # Whether views are judged; without, all are kept.
    enabled: bool = True
    # Smallest expected peak signal-to-noise ratio of an episode, in dB.
    min_expected_db: float = between(14.0, 0, 60)
    # Largest median distance from the tracks to the motion, in pixels of the fitted image.
    max_track_px: float = between(8.0, 0, INFINITY)
    # Largest flicker of what stands still, relative to the video's own.
    max_flicker_ratio: float = between(2.0, 0, INFINITY)
    # Largest flash, a frame that is brighter or darker somewhere than those before and after, relative to the video's.
    max_flash_ratio: float = between(2.0, 0, INFINITY)
    # Smallest sharpness (variance of the Laplacian), relative to the video's.
    min_sharpness_ratio: float = between(0.1, 0, INFINITY)
    # Of a camera that moves: by how many pixels (of 320) a rolling shutter may bend fast frames; it is taken to read a
    # picture in half of the time between two. To be raised for a global shutter.
    max_skew_px: float = between(12.0, 0, INFINITY)
    # Of a camera that moves: smallest sharpness of its fast frames, relative to its slow ones: motion blur.
    min_fast_sharpness: float = between(0.1, 0, INFINITY)
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
    # Whether the reconstructed scenes are kept in the output, for training on views of them (docs/scene.md).
    save_scenes: bool = False
    # Output of an earlier run with save_scenes, a folder or a name, whose scenes are rendered again: nothing is fitted
    # anew, and settings of priors, scene, motion and fit have no effect.
    scenes: Path | None = None
    # Seed of every random choice; together with the episode and the variant it fixes the result.
    seed: int = between(0, 0, MAX_SEED)
    # Where it runs: auto, cpu or cuda; auto takes a GPU where everything is there to draw on it (docs/render.md).
    device: Device = "auto"
    # Whether a GPU encodes new H.264 and HEVC videos where it can: faster, but not as the source's encoder would.
    nvenc: bool = False
    camera: CameraConfig = field(default_factory=CameraConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
    priors: PriorsConfig = field(default_factory=PriorsConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    perturbation: Perturbation = field(default_factory=lambda: Perturbation.get_choice_class("orbit")())
    # Largest share of a new view that no frame has shown, 0..1; a change that shows more is shrunk, or rejected.
    max_unseen: float = between(0.2, 0, 1)
    # What stands where nothing was seen: inpaint (continued from what is behind), nearest, blur (the colours around),
    # noise (random colours), or none (black).
    fill: Fill = "inpaint"
    # Cut off what was not seen at the borders: a longer focal length at the same number of pixels.
    crop_to_covered: bool = False
    # Keep masks of what was not seen, per frame, in meta/msdyn/unseen/.
    masks: bool = False
    # Whether cameras that move, in a hand or on a head, may be re-rendered; those on the gripper are copied always.
    allow_moving: bool = False
    gate: GateConfig = field(default_factory=GateConfig)

    @property
    def needs_whole_videos(self) -> bool:
        """Whether a prior is for a whole video: exchange files, and the poses of a moving camera."""
        return self.priors.needs_whole_videos or self.camera.needs_whole_videos


def _needs_whole_videos(choice: str, registry: Registry) -> bool:
    name = choice.partition(PARAMETER)[0]
    return choice.endswith(FILE) or (name in registry and bool(registry.get(name).needs_whole_videos))
