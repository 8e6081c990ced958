"""Videos that several tests share."""

import pytest
from sliding import Clip


@pytest.fixture(scope="session")
def sliding() -> Clip:
    return Clip()
