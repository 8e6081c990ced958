"""What the benchmark of the pipeline says of seams and of growth."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> tuple[ModuleType, ModuleType]:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("seams"), importlib.import_module("pipeline")


def test_a_jump_is_told_from_what_usually_changes(modules: tuple[ModuleType, ModuleType]) -> None:
    values = torch.zeros(6, 4, 4)
    values[1::2] += 1.0  # by 1 from frame to frame
    values[3:] += 4.0
    values[:, 0] += 100 * torch.arange(6.0)[:, None]  # what moves
    still = torch.ones(4, 4, dtype=torch.bool)
    still[0] = False
    found = modules[0].jump(values, still, 3)
    assert (found.at_seam, found.usual) == (5.0, 1.0)


def test_growth_is_given_by_axis(modules: tuple[ModuleType, ModuleType]) -> None:
    _, pipeline = modules
    cases = pipeline.GROWTH
    assert [case.name for case in cases] == [
        "base",
        *(f"{axis} x {times}" for axis in pipeline.AXES for times in (2, 4)),
    ]
    seconds = {"base": 1.0, "frames x 2": 2.0, "frames x 4": 4.0, "pixels x 2": 2.0, "pixels x 4": 8.0}
    rows: list[dict[str, Any]] = [{"cpu all": seconds.get(case.name, 1.0)} for case in cases]
    lines = pipeline.powers(rows)
    assert lines[0].endswith("power 1.00: linear or less")
    assert lines[1].endswith("power 2.00: MORE THAN LINEAR")
    assert lines[2].endswith("power 0.00: linear or less")
