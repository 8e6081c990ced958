"""Views of saved scenes, rendered while a policy is trained (docs/training.md)."""

from lerobot_msdyn.training.mixed import MixedViews
from lerobot_msdyn.training.streamed import MixedStream

__all__ = ["MixedStream", "MixedViews"]
