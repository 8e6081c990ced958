"""Rendering Gaussians: one interface, several backends that must agree (the reference decides)."""

from lerobot_msdyn.render.backends import rasterize
from lerobot_msdyn.render.types import Raster

__all__ = ["Raster", "rasterize"]
