"""Rendering Gaussians: one interface, several backends that must agree (the reference decides)."""

from lerobot_msdyn.render.backdrop import Backdrop, Painted
from lerobot_msdyn.render.backends import project_backdrop, rasterize
from lerobot_msdyn.render.types import Raster

__all__ = ["Backdrop", "Painted", "Raster", "project_backdrop", "rasterize"]
