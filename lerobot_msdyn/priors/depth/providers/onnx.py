"""Any depth network in a file of ONNX."""

from dataclasses import replace
from pathlib import Path

from jaxtyping import Float, UInt8
from torch import Tensor

from lerobot_msdyn.core.config import PriorsConfig
from lerobot_msdyn.core.files import digest_of_file
from lerobot_msdyn.priors.depth.metres import in_metres
from lerobot_msdyn.priors.depth.onnx_network import OnnxNetwork
from lerobot_msdyn.priors.depth.onnx_spec import read_spec
from lerobot_msdyn.priors.depth.predicted import predicted
from lerobot_msdyn.priors.hub import demand_library
from lerobot_msdyn.priors.onnx_file import NETWORK_SUFFIX
from lerobot_msdyn.priors.registry import DEPTH, Depth, DepthProvider, Estimate, Masks, Unusable
from lerobot_msdyn.priors.request import Request


@DEPTH.register("onnx")
class Onnx(DepthProvider):
    """Depth Anything, MiDaS, Metric3D and others as they are exported; used by name alone."""

    parameter = f"FILE{NETWORK_SUFFIX}"

    def __init__(self, file: str) -> None:
        self._file = Path(file).expanduser()

    def check(self, config: PriorsConfig, device: str) -> None:
        """The file is loaded, and what is stated of it is read."""
        self._demand()
        OnnxNetwork(self._file, read_spec(self._file, config.onnx)[0], device)

    def usable(self, request: Request) -> str:
        """The file and onnxruntime are there."""
        self._demand()
        return "its file is there"

    def _demand(self) -> None:
        demand_library("onnxruntime", "onnx", "a network in a file of ONNX")
        if not self._file.is_file():
            raise Unusable(f"there is no file {self._file}", f"expected onnx:{self.parameter}")

    def estimate(self, request: Request, instances: Masks) -> Estimate[Depth]:
        """Aligned to the best depth that needs no network, where there is one in true metres or it has no scale."""
        spec, told = read_spec(self._file, request.config.onnx)
        digest = digest_of_file(self._file)
        intrinsics = request.view.camera.intrinsics[0]

        def predict(rgb: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n h w"]:
            return OnnxNetwork(self._file, spec, request.device)(rgb, intrinsics)

        settings = {"file": digest, "spec": vars(spec), "focal_px": float(intrinsics[0, 0]) if spec.focal_px else 0}
        values, elsewhere = predicted(request, "onnx", settings, predict)
        estimate = in_metres(request, instances, values, spec.kind, trusted=False, elsewhere=elsewhere)
        return replace(estimate, how=f"read {told}; {estimate.how}", model=spec.origin(self._file.name, digest))
