"""What an output says of the settings that made it."""

from pathlib import Path

import yaml

from lerobot_msdyn.augment.config import AugmentConfig
from lerobot_msdyn.augment.run_identity import recipe_text
from lerobot_msdyn.core.config import CameraConfig, PriorsConfig, Recipe, RobotConfig


def test_a_recipe_in_an_output_names_no_folder_of_the_user() -> None:
    config = AugmentConfig(
        repo_id="local/ds",
        root=Path("/home/ann/ds"),
        camera=CameraConfig(calibration=Path("/home/ann/rig.json")),
        robot=RobotConfig(urdf=Path("/home/ann/arm/arm.urdf")),
        priors=PriorsConfig(depth="/home/ann/depth/{episode}.npz", masks="onnx:/home/ann/sam", cache="/home/ann/cache"),
    )
    text = recipe_text(config)
    assert "ann" not in text
    kept = yaml.safe_load(text)
    assert kept["camera"]["calibration"] == "rig.json"
    assert kept["robot"]["urdf"] == "arm.urdf"
    assert kept["priors"]["depth"] == "{episode}.npz"
    assert kept["priors"]["masks"] == "onnx:sam"
    assert kept["fit"] == yaml.safe_load(recipe_text(Recipe()))["fit"]
