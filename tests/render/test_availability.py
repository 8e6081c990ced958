"""What is missing for the GPU is named in one line, with what to do about it."""

import sys
from types import ModuleType

import pytest
import torch
from torch.utils import cpp_extension

from lerobot_msdyn.core.errors import ConfigError, RenderError
from lerobot_msdyn.render import availability, rasterize
from lerobot_msdyn.render.availability import cuda_problem


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A machine with all that is needed; a test takes something away."""
    cuda_problem.cache_clear()
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(availability.importlib.util, "find_spec", lambda name: None if name == "gsplat.csrc" else name)
    monkeypatch.setattr(cpp_extension, "CUDA_HOME", "/opt/cuda")
    monkeypatch.setattr(availability.shutil, "which", lambda name, path=None: name)
    monkeypatch.setattr(availability, "_failure", lambda: "")
    return monkeypatch


@pytest.fixture(autouse=True)
def _asked_again() -> object:
    yield
    cuda_problem.cache_clear()


def test_nothing_is_missing(machine: pytest.MonkeyPatch) -> None:
    assert cuda_problem() == ""


def test_torch_without_cuda(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(torch.version, "cuda", None)
    assert "this torch was built without CUDA; install one with it" in cuda_problem()


def test_no_device(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(torch.cuda, "is_available", lambda: False)
    assert "torch sees no CUDA device; look at nvidia-smi" in cuda_problem()


def test_no_gsplat(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(availability.importlib.util, "find_spec", lambda name: None)
    assert cuda_problem() == "gsplat is not installed; install it with: pip install 'lerobot_msdyn[cuda]'"


@pytest.mark.parametrize("home", [None, "/opt/cuda"])
def test_no_compiler_for_the_gpu(machine: pytest.MonkeyPatch, home: str | None) -> None:
    machine.setattr(cpp_extension, "CUDA_HOME", home)
    machine.setattr(availability.shutil, "which", lambda name, path=None: None if name == "nvcc" else name)
    assert "there is no nvcc; install the CUDA toolkit 13.0" in cuda_problem()


def test_no_compiler_for_the_processor(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(availability.shutil, "which", lambda name, path=None: name if name == "nvcc" else None)
    assert "there is no C++ compiler" in cuda_problem()


def test_a_wheel_with_kernels_needs_no_compiler(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(availability.importlib.util, "find_spec", lambda name: name)
    machine.setattr(cpp_extension, "CUDA_HOME", None)
    assert cuda_problem() == ""


def test_kernels_that_do_not_compile_are_said_in_one_line(machine: pytest.MonkeyPatch) -> None:
    machine.undo()
    broken = ModuleType("lerobot_msdyn.render.cuda")

    def fail(*arguments: object) -> None:
        raise RuntimeError("Error building extension 'gsplat_cuda'\nmany\nlines")

    broken.render_with_gsplat = fail  # type: ignore[attr-defined]
    ones = torch.ones
    eye = torch.eye
    machine.setitem(sys.modules, "lerobot_msdyn.render.cuda", broken)
    machine.setattr(availability.importlib.metadata, "version", lambda name: "1.5.3")
    machine.setattr(torch, "ones", lambda *shape, device: ones(*shape))
    machine.setattr(torch, "eye", lambda size, device: eye(size))
    reason = availability._failure()
    assert reason.startswith("gsplat 1.5.3 cannot compile or run its kernels (Error building extension 'gsplat_cuda')")
    assert "\n" not in reason


def test_what_is_missing_is_said_where_the_gpu_was_demanded(machine: pytest.MonkeyPatch) -> None:
    from lerobot_msdyn.render import backends
    from lerobot_msdyn.render.devices import chosen_device

    machine.setattr(torch.cuda, "is_available", lambda: False)
    backends._load.cache_clear()
    with pytest.raises(ConfigError, match=r"device is 'cuda', but torch sees no CUDA device.*or use --device cpu"):
        chosen_device("cuda")
    one = torch.ones(1, 4)
    camera = torch.eye(4)[None]
    with pytest.raises(RenderError, match="backend 'cuda' cannot be used: torch sees no CUDA device"):
        rasterize(one[:, :3], one, one[:, :3], one[:, 0], one, camera, camera[:, :3, :3], 4, 4, backend="cuda")
    backends._load.cache_clear()


@pytest.mark.parametrize(("available", "level"), [(False, "INFO"), (True, "WARNING")])
def test_auto_says_once_why_it_is_not_the_gpu(
    machine: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, available: bool, level: str
) -> None:
    from lerobot_msdyn.render import devices

    devices._say_once.cache_clear()
    machine.setattr(torch.cuda, "is_available", lambda: available)
    machine.setattr(availability.importlib.util, "find_spec", lambda name: None)
    with caplog.at_level("INFO"):
        assert [devices.chosen_device("auto") for _ in range(2)] == [torch.device("cpu")] * 2
    logged = [record for record in caplog.records if record.name == "lerobot_msdyn.render.devices"]
    assert [(record.levelname, "fitting and rendering on the CPU" in record.getMessage()) for record in logged] == [
        (level, True)
    ]
    caplog.clear()
    assert devices.chosen_device("cpu") == torch.device("cpu")
    assert caplog.records == []
    devices._say_once.cache_clear()


def test_networks_need_a_gpu_but_not_gsplat(machine: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    from lerobot_msdyn.render.devices import chosen_device

    machine.setattr(availability.importlib.util, "find_spec", lambda name: None)
    devices = [chosen_device(name, networks=True).type for name in ("auto", "cpu", "cuda")]
    assert devices == ["cuda", "cpu", "cuda"]
    with pytest.raises(ConfigError, match="device is 'cuda', but gsplat is not installed"):
        chosen_device("cuda")
    machine.setattr(torch.cuda, "is_available", lambda: False)
    with caplog.at_level("INFO"):
        assert [chosen_device(name, networks=True).type for name in ("auto", "cpu")] == ["cpu", "cpu"]
    assert caplog.records == []
    with pytest.raises(ConfigError, match=r"device is 'cuda', but torch sees no CUDA device.*or use --device cpu"):
        chosen_device("cuda", networks=True)


def test_auto_takes_the_gpu(machine: pytest.MonkeyPatch) -> None:
    from lerobot_msdyn.render.devices import chosen_device

    assert [chosen_device(name) for name in ("auto", "cuda")] == [torch.device("cuda")] * 2
