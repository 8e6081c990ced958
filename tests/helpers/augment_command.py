"""The command `augment` on `desk`, as short as it can be."""

import pytest

from lerobot_msdyn.augment import __main__ as augment
from lerobot_msdyn.core.cli import run_command

FRONT, SIDE = "observation.images.front", "observation.images.side"
FAST = ("--fit.steps", "8", "--scene.moving_gaussians", "500", "--scene.moving_frames", "4", "--fit.max_width", "48")


def run(*arguments: str) -> int:
    """The exit code of the command."""
    with pytest.raises(SystemExit) as caught:
        run_command(augment.run, [*arguments])
    assert isinstance(caught.value.code, int)
    return caught.value.code
