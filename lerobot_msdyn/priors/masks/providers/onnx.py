"""Segment Anything or its like as two files of ONNX."""

from pathlib import Path

import numpy as np
import torch

from lerobot_msdyn.core.config import PriorsConfig
from lerobot_msdyn.core.files import digest_of_file
from lerobot_msdyn.priors.cache import digest_of
from lerobot_msdyn.priors.hub import demand_library
from lerobot_msdyn.priors.masks.providers.change import Change
from lerobot_msdyn.priors.masks.refined import refined
from lerobot_msdyn.priors.masks.sam_onnx import SamNetworks, network_files, read_sam_spec
from lerobot_msdyn.priors.registry import MASKS, Estimate, MaskProvider, Masks, Unusable
from lerobot_msdyn.priors.request import Request


@MASKS.register("onnx")
class Onnx(MaskProvider):
    """MobileSAM, Segment Anything and others as they are exported; used by name alone."""

    parameter = "FOLDER"

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder).expanduser()

    def check(self, config: PriorsConfig, device: str) -> None:
        """The networks are loaded, and what is stated of them is read."""
        self._demand()
        SamNetworks(self._folder, device)

    def usable(self, request: Request) -> str:
        """The folder and onnxruntime are there."""
        self._demand()
        return "its folder is there"

    def _demand(self) -> None:
        demand_library("onnxruntime", "onnx", "a network in files of ONNX")
        if not self._folder.is_dir():
            raise Unusable(f"there is no folder {self._folder}", f"expected onnx:{self.parameter}")

    def estimate(self, request: Request) -> Estimate[Masks]:
        """The instances that were found without weights, with the network's outlines."""
        found = Change().estimate(request).value
        spec = read_sam_spec(self._folder)
        digest = "+".join(digest_of_file(file) for file in network_files(self._folder))

        def compute() -> dict[str, np.ndarray]:
            network = SamNetworks(self._folder, request.device)
            return {"masks": refined(request.view.rgb.numpy(), found.numpy(), network)}

        settings = {"files": digest, "spec": vars(spec), "shown": digest_of(found)}
        arrays = request.cache.get("masks", "onnx", settings, compute)
        return Estimate(torch.from_numpy(arrays["masks"]), model=spec.origin(self._folder.name, digest))
