"""Any depth network in a file of ONNX."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lerobot_msdyn.core.files import digest_of_file
from lerobot_msdyn.core.observations import Model
from lerobot_msdyn.priors.depth.metres import in_metres
from lerobot_msdyn.priors.depth.onnx_network import OnnxNetwork
from lerobot_msdyn.priors.depth.onnx_spec import NETWORK_SUFFIX, read_spec
from lerobot_msdyn.priors.hub import demand_library
from lerobot_msdyn.priors.models import UNKNOWN_LICENCE
from lerobot_msdyn.priors.registry import DEPTH, Depth, DepthProvider, Estimate, Masks, Unusable
from lerobot_msdyn.priors.request import Request


@DEPTH.register("onnx")
class Onnx(DepthProvider):
    """Depth Anything, MiDaS, Metric3D and others as they are exported; used by name alone."""

    parameter = f"FILE{NETWORK_SUFFIX}"

    def __init__(self, file: str) -> None:
        self._file = Path(file).expanduser()

    def usable(self, request: Request) -> str:
        """The file and onnxruntime are there."""
        demand_library("onnxruntime", "onnx", "a network in a file of ONNX")
        if not self._file.is_file():
            raise Unusable(f"there is no file {self._file}", f"expected onnx:{self.parameter}")
        return "its file is there"

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """Aligned to the best depth that needs no network, where there is one in true metres or it has no scale."""
        spec, told = read_spec(self._file, request.config.onnx)
        digest = digest_of_file(self._file)
        intrinsics = request.view.camera.intrinsics[0]

        def compute() -> dict[str, np.ndarray]:
            values = OnnxNetwork(self._file, spec, request.device)(request.view.rgb, intrinsics).numpy()
            known = np.abs(values[np.isfinite(values)])
            unit = float(known.mean()) if len(known) and known.mean() > 0 else 1.0  # half floats hold what is near 1
            return {"values": (values / unit).astype(np.float16), "unit": np.array(unit)}

        settings = {"file": digest, "spec": vars(spec), "focal_px": float(intrinsics[0, 0]) if spec.focal_px else 0}
        arrays = request.cache.get("depth", "onnx", settings, compute)
        values = torch.from_numpy(arrays["values"].astype(np.float32) * float(arrays["unit"]))
        estimate = in_metres(request, instances, values, spec.kind, trusted=False)
        model = Model(spec.model or self._file.name, spec.revision or digest, spec.licence or UNKNOWN_LICENCE)
        return replace(estimate, how=f"read {told}; {estimate.how}", model=model)
