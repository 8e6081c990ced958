"""Depth without a sensor or learned weights: everything stands on a table."""

from lerobot_msdyn.core.observations import DepthTraits
from lerobot_msdyn.priors.depth.table_plane import ground_plane, table_plane, with_standing
from lerobot_msdyn.priors.depth.uprights import empty_scene, still_error, with_boxes
from lerobot_msdyn.priors.registry import DEPTH, Depth, DepthProvider, Estimate, Masks
from lerobot_msdyn.priors.request import Request
from lerobot_msdyn.priors.robot import RELATIVE_ERROR


@DEPTH.register("plane")
class Plane(DepthProvider):
    """A table at the height and tilt that `camera.height_m` and `camera.tilt_deg` state, or under a calibrated robot.

    On a robot's table things that keep still stand upright, where edges say that they do, and small ones that move are
    boxes.
    It can always be used.
    """

    rank = 10
    reads_recorded_depth = False
    is_reference = True

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """Assumed, not measured, but where a robot stands on the table."""
        view, empty = request.view, None
        if view.robot is not None:
            ground = ground_plane(view.camera, view.robot.ground_m)
            empty = empty_scene(view, view.robot, ground, instances) if view.camera.is_static else ground
            traits = DepthTraits(metric=True, relative_error=RELATIVE_ERROR, still_error=still_error(empty, ground))
            how = "the table that the robot stands on, and what stands on it"
        else:
            height_m, tilt_deg = request.camera.height_m, request.camera.tilt_deg
            width, height = view.camera.width, view.camera.height
            ground = table_plane(width, height, view.camera.intrinsics[0], height_m, tilt_deg)
            traits = DepthTraits(sharp=True, relative_error=0.10, assumed=True)
            how = f"a table seen from {height_m:g} m at {tilt_deg:g} degrees"
        depth = with_standing(ground, instances, empty)
        if view.robot is not None and view.camera.is_static:
            depth = with_boxes(depth, instances, view.camera, view.robot.ground_m)
        return Estimate(Depth(depth, traits, ground), how)
