"""The providers that a recipe's fields choose from by name; `priors/registry.py` says what a provider is."""

from typing import Any

from lerobot_msdyn.core.registry import Registry

DEPTH: Registry[Any] = Registry("depth provider", "lerobot_msdyn.priors.depth.providers")
MASKS: Registry[Any] = Registry("mask provider", "lerobot_msdyn.priors.masks.providers")
TRACKS: Registry[Any] = Registry("track provider", "lerobot_msdyn.priors.tracks.providers")
CAMERAS: Registry[Any] = Registry("camera provider", "lerobot_msdyn.priors.camera.providers")
