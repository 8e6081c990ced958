"""What the command lines of `evaluate` set; no torch here, so that `--help` answers at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.fields import MAX_INDEX, between

# Named: draccus finds the comment above a field only where its annotation holds no quotes.
Protocol = Literal["som", "dycheck"]


@dataclass
class ScoredConfig(Recipe):
    """What all evaluations share."""

    # AlexNet's features for mLPIPS: the state of lpips.LPIPS(net='alex').net, or torchvision's checkpoint. Default:
    # where `python -m lerobot_msdyn.models fetch alexnet` puts it. Without, mLPIPS is left out.
    lpips_weights: Path | None = None


@dataclass
class EvaluateConfig(ScoredConfig):
    """`python -m lerobot_msdyn.evaluate nvs`: fit one episode, render its held-out cameras."""

    # Folder with dataset/ (or dataset_depth/) and gt/, see docs/evaluate.md.
    scene_folder: Path = Path()
    # Where the rendered views go: OUT/<camera>/rgb_%04d.png; and OUT/scores.json.
    out: Path = Path()
    # recorded, none, another provider of priors.depth (onnx:FILE.onnx), or an .npz file with depth [t,h,w].
    depth: str = "recorded"
    # Whether one factor of all depths is fitted to the true views as well, which tells wrong shape from wrong scale.
    fit_scale: bool = False

    @property
    def depth_provider(self) -> str:
        """What `depth` is in the priors' terms."""
        return {"recorded": "recorded", "none": "plane"}.get(self.depth, self.depth)


@dataclass
class DycheckConfig(ScoredConfig):
    """`python -m lerobot_msdyn.evaluate dycheck`: fit a DyCheck iPhone sequence, score its validation views."""

    # Folder of the sequence, with rgb/, splits/ and so on, see docs/evaluate.md.
    root: Path = Path()
    # Where the rendered views go: OUT/rgb/<id>.png; and OUT/scores.json.
    out: Path = Path()
    # som (1x pictures, Shape of Motion's processed package) or dycheck (2x pictures, cameras of the sequence).
    protocol: Protocol = "som"


@dataclass
class HeldoutCameraConfig(ScoredConfig):
    """`python -m lerobot_msdyn.evaluate heldout-camera`: fit one camera of a rig, score what another one saw."""

    # Source dataset (alias: --repo).
    repo_id: str = ""
    # Exact folder of the source dataset; default: LeRobot's home, then the hub.
    root: Path | None = None
    # The episode.
    episode: int = between(0, 0, MAX_INDEX)
    # The camera that is fitted, by feature key or its last part.
    train_camera: str = ""
    # The camera that is compared with; it is not fitted.
    test_camera: str = ""
    # Where the rendered views go: OUT/rgb_%04d.png; and OUT/scores.json.
    out: Path = Path()
