"""The learned models that this package knows: what each is for, its licence, and exactly which files it means.

Licences as the model cards state them. No default of this package is restricted to non-commercial use.
"""

from dataclasses import dataclass
from pathlib import PurePosixPath

UNKNOWN_LICENCE = "unknown: read its model card"
NON_COMMERCIAL = "CC-BY-NC-4.0"


@dataclass(frozen=True)
class KnownModel:
    """One model."""

    place: str  # its id on the Hugging Face hub, or the address of a single file
    licence: str
    size_mb: int  # of what is fetched
    purpose: str
    revision: str = ""  # the commit that is meant, on the hub
    sha256: str = ""  # of its weights, or how that begins; empty: not known
    companion: str = ""  # id of a model whose configuration is read as well

    @property
    def is_file(self) -> bool:
        """Whether it is a single file, which lies in torch's folder of checkpoints."""
        return self.place.startswith("https://")

    @property
    def file(self) -> str:
        """Name of the single file."""
        return PurePosixPath(self.place).name


MODELS = {
    "depth_anything_metric": KnownModel(
        "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
        "Apache-2.0",
        99,
        "depth of videos without recorded depth (priors.depth)",
        revision="8078d68a9c75a972131914f6afd0c1723be0da7f",
        sha256="e990eb82fbf11b05b7813261196a2b841bdcf5a05f64396724a8987fa90504a3",
    ),
    "depth_anything": KnownModel(
        "depth-anything/Depth-Anything-V2-Small-hf",
        "Apache-2.0",
        99,
        "relative depth, where cameras are calibrated (priors.depth)",
        revision="5426e4f0f36572d16453bbda7a8389317b1bef99",
        sha256="3152477ce0d8d6978d76b995120de97cb5b928701fd0f817769f59e249a16b70",
    ),
    "sam2": KnownModel(
        "facebook/sam2.1-hiera-tiny",
        "Apache-2.0",
        156,
        "masks of what moves (priors.masks)",
        revision="de431c4043854a71d8101e17995dfe596bf101a5",
        sha256="48c14467e5cf9e51870511feb72c89688e82dd74523142c0538b663e193ac2a7",
    ),
    "edgetam": KnownModel(
        "yonigozlan/EdgeTAM-hf",
        "Apache-2.0",
        56,
        "the same, smaller and faster (priors.masks)",
        revision="c266ce53b3fc00f0f495b583f6a116c4e57f53bb",
        companion="timm/repvit_m1.dist_in1k",
    ),
    "raft": KnownModel(
        "https://download.pytorch.org/models/raft_small_C_T_V2-01064c6d.pth",
        "BSD-3-Clause",
        4,
        "optical flow for tracks (priors.tracks)",
        sha256="01064c6d",
    ),
    "alexnet": KnownModel(
        "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
        "BSD-3-Clause",
        244,
        "mLPIPS of evaluate (lpips_weights)",
        sha256="7be5be79",
    ),
}
# Other models of the same families, by id; what is not listed has an unknown licence.
OTHER_LICENCES = {
    "facebook/sam2.1-hiera-small": "Apache-2.0",
    "facebook/sam2.1-hiera-base-plus": "Apache-2.0",
    "facebook/sam2.1-hiera-large": "Apache-2.0",
    "depth-anything/Depth-Anything-V2-Base-hf": NON_COMMERCIAL,
    "depth-anything/Depth-Anything-V2-Large-hf": NON_COMMERCIAL,
    "depth-anything/Depth-Anything-V2-Metric-Indoor-Base-hf": NON_COMMERCIAL,
    "depth-anything/Depth-Anything-V2-Metric-Indoor-Large-hf": NON_COMMERCIAL,
}


def known_as(place: str) -> str:
    """The name under which a model is known; empty if it is not."""
    return next((name for name, model in MODELS.items() if model.place == place), "")


def licence_of(place: str, otherwise: str = UNKNOWN_LICENCE) -> str:
    """The licence of a model by its id."""
    name = known_as(place)
    return MODELS[name].licence if name else OTHER_LICENCES.get(place, otherwise)


def how_to_fetch(place: str) -> str:
    """The command that fetches a model."""
    name = known_as(place)
    return f"python -m lerobot_msdyn.models fetch {name}" if name else f"hf download {place}"
