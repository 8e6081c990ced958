"""Other systems' models of motion, which register as a user's own levels do (docs/extending.md)."""

from pathlib import Path

from lerobot_msdyn.core.plugins import import_plugins


def register() -> None:
    """Make the motion levels `flat` and `field` known."""
    import_plugins(str(Path(__file__).with_name(name)) for name in ("flat.py", "field.py"))
