"""Whether there is what a command line names, as far as that is told without LeRobot and torch, which take long."""

from collections.abc import Sequence

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.core.config import Recipe
from lerobot_msdyn.core.errors import ConfigError
from lerobot_msdyn.dataset.calibration_file import names_camera
from lerobot_msdyn.dataset.metadata import Metadata, described
from lerobot_msdyn.dataset.named import output_folder
from lerobot_msdyn.dataset.select import check_cameras_named, select_cameras, select_episodes
from lerobot_msdyn.priors.files import check_files
from lerobot_msdyn.robots import check_description
from lerobot_msdyn.scene.folders import list_scenes


def check_asked(config: AugmentConfig) -> None:
    """Whether there are the episodes, the cameras, the robot's description and the files that the settings name.

    Raises:
        MsdynError: one of them is not there, or the dataset is none that can be read.
    """
    meta = None if config.convert else described(config.repo_id, config.root)
    check_files(config.camera, None if config.scenes else config.priors)
    if config.scenes is not None:
        list_scenes(output_folder(config.scenes))
    if meta is None:
        return
    episodes = select_episodes(meta, config.episodes)
    cameras = select_cameras(meta, config.cameras, allow_moving=config.allow_moving)
    check_cameras_named(meta, config.camera.pose_columns)
    check_robot(meta, cameras, config)
    other, file = config.perturbation.needs_pose_of, config.camera.calibration
    if other is not None and not (names_camera(file, other, episodes) if file else asks_the_joints(config)):
        raise no_other_camera(config)


def check_robot(meta: Metadata, cameras: Sequence[str], config: Recipe) -> None:
    """Whether the description of the robot is there that a recipe names, where it is to tell where cameras stand.

    Raises:
        ConfigError: it is not.
    """
    named = config.robot.urdf is not None or config.robot.name
    if named and asks_the_joints(config) and any(config.camera.pose_column(key) is None for key in cameras):
        check_description(config.robot, meta.robot_type)


def asks_the_joints(recipe: Recipe) -> bool:
    """Whether a robot's joints may tell where cameras stand."""
    return recipe.camera.by_robot and recipe.camera.calibration is None and recipe.scenes is None


def no_other_camera(recipe: Recipe) -> ConfigError:
    """What to say where no calibration has the camera that the perturbation looks from."""
    return ConfigError(
        f"perturbation.camera is {recipe.perturbation.needs_pose_of!r}, which the calibration "
        f"{recipe.camera.calibration} does not name; expected a camera with K, R and t there "
        "(--camera.calibration FILE)"
    )
