"""Whether gsplat can render here; if not, what is missing and how to get it, in one line."""

import importlib.metadata
import importlib.util
import logging
import shutil
from functools import cache

import torch

_log = logging.getLogger(__name__)

# What a first call of gsplat may raise where its kernels cannot be compiled or run; `_C` is None without a toolkit.
_FAILURES = (ImportError, RuntimeError, OSError, AttributeError, IndexError)


@cache
def cuda_problem() -> str:
    """Why backend 'cuda' cannot be used, and what to do about it; empty if it can, which has been tried."""
    return _missing() or _failure()


def has_cuda_device() -> bool:
    """Whether torch sees a CUDA device."""
    return torch.cuda.is_available()


def no_device_problem() -> str:
    """Why torch cannot use a GPU, and what to do about it; empty if it can."""
    if torch.version.cuda is None:
        return "this torch was built without CUDA; install one with it (https://pytorch.org/get-started/locally)"
    if not has_cuda_device():
        return "torch sees no CUDA device; look at nvidia-smi, the driver and CUDA_VISIBLE_DEVICES"
    return ""


def _missing() -> str:
    """What is absent, as far as that can be told without compiling anything."""
    problem = no_device_problem()
    if problem:
        return problem
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed; install it with: pip install 'lerobot_msdyn[cuda]'"
    if importlib.util.find_spec("gsplat.csrc") is not None:  # a wheel with kernels
        return ""
    from torch.utils import cpp_extension  # only here: without a device its import writes warnings

    if cpp_extension.CUDA_HOME is None or shutil.which("nvcc", path=f"{cpp_extension.CUDA_HOME}/bin") is None:
        return (
            f"gsplat compiles its kernels once, and there is no nvcc; install the CUDA toolkit {torch.version.cuda} "
            "(https://developer.nvidia.com/cuda-downloads) and set CUDA_HOME"
        )
    if shutil.which(cpp_extension.get_cxx_compiler()) is None:
        return "gsplat compiles its kernels once, and there is no C++ compiler; install g++, or set CXX"
    return ""


def _failure() -> str:
    """Render one Gaussian, by which gsplat compiles its kernels where it has not yet."""
    version = importlib.metadata.version("gsplat")
    _log.info("loading gsplat %s; its kernels are compiled once, which takes minutes", version)
    try:
        from lerobot_msdyn.render.cuda import render_with_gsplat

        one, eye = torch.ones(1, 4, device="cuda"), torch.eye(4, device="cuda")[None]
        raster = render_with_gsplat(one[:, :3], one, one[:, :3], 0.5 * one[:, 0], one, eye, eye[:, :3, :3], 8, 8, 0.01)
        raster.alpha.sum().item()
    except _FAILURES as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        return (
            f"gsplat {version} cannot compile or run its kernels ({reason}); see what VERBOSE=1 python -c "
            "'from gsplat.cuda._backend import _C' says"
        )
    return ""
