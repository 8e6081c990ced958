"""The dataset card of an output: that it is synthetic, from what, by which recipe, with which limits."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import yaml
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.utils import create_lerobot_dataset_card

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.core.files import write_whole
from lerobot_msdyn.dataset.checks import regular_file
from lerobot_msdyn.dataset.provenance import RECIPE, SOURCE_VARIANT, read_provenance

CARD = "README.md"
MAX_CARD_BYTES = 1 << 20
TAGS = ["synthetic", "novel-view", "lerobot_msdyn"]
MADE_BY = "rendered by lerobot_msdyn, a plugin for LeRobot"
PAPER = "https://arxiv.org/abs/2602.13806 (the method of rendering)"
CITATION = """\
@article{li2026gaussian,
  title   = {Gaussian Sequences with Multi-Scale Dynamics for 4D Reconstruction from Monocular Casual Videos},
  author  = {Li, Can and Gu, Jie and Chen, Jingmin and Qiu, Fangzhou and Sun, Lei},
  journal = {arXiv preprint arXiv:2602.13806},
  year    = {2026}
}"""
NO_LICENCE = "unknown"  # the Hub's word for it
DESCRIPTION = """\
**{rendered} of the {episodes} episodes of this dataset are synthetic.** Their pictures were not recorded: they were
rendered by lerobot_msdyn {version} from Gaussian scenes that were fitted to recorded episodes, as seen from cameras
that were moved. Actions, states and times are those of the recording.

{sources}

`meta/msdyn/episodes.parquet` says for every episode from which recording it comes, which variant it is, and what was
sampled for its camera; `meta/msdyn/recipe.yaml` is the recipe.{models}

### Limits

* What no frame of a recording shows is filled in from its surroundings.
* Shadows belong to surfaces; where something hid the ground, its shadow is missing.
* Fast and thin things come out ragged.
* Cameras were taken as fixed. Without recorded depth the scene is a table plane with things on it.
* A policy that is evaluated on rendered pictures is not evaluated on a camera.

### Splitting for evaluation

Episodes that were rendered from one recording show the same actions. Held out at random, or by LeRobot's own
`--dataset.eval_split` alone, re-renders of training episodes end up in the evaluation. Split by recording:

```sh
lerobot-train $(python -m lerobot_msdyn.split --root FOLDER) --dataset.repo_id={repo_id} --dataset.root=FOLDER ...
```

### Recipe

```yaml
{recipe}
```
"""


def card_arguments(root: Path, repo_id: str, licence: str | None = None) -> dict[str, Any]:
    """What LeRobot's `push_to_hub` must be given so that the card that it writes says the same.

    `LeRobotDataset(repo_id, root).push_to_hub(**card_arguments(root, repo_id))` uploads all of the folder, meta/msdyn
    included, and writes the card last. Without a licence, the one that the folder's card names is kept.
    """
    rows = read_provenance(root) or []
    recipe = (root / RECIPE).read_text().strip() if (root / RECIPE).is_file() else "(several; see the parts)"
    rendered = [row for row in rows if row["variant"] != SOURCE_VARIANT]
    count = Counter(row["source_repo_id"] for row in rows)
    models = {name: terms for row in rows for name, terms in json.loads(row.get("licences") or "{}").items()}
    used = "".join(f"\n* {name}: {terms}" for name, terms in sorted(models.items()))
    description = DESCRIPTION.format(
        rendered=len(rendered),
        episodes=len(rows),
        version=", ".join(sorted({row["version"] for row in rows if row.get("version")})),
        sources="\n".join(f"* {number} episodes from {name}" for name, number in sorted(count.items())),
        models=f" Models that took part, and their licences:\n{used}" if used else "",
        repo_id=repo_id,
        recipe=recipe,
    )
    return {
        "tags": TAGS,
        "license": licence or licence_of(root) or NO_LICENCE,
        "dataset_description": description,
        "url": MADE_BY,
        "paper": PAPER,
        "citation_bibtex": CITATION,
    }


def write_card(root: Path, repo_id: str, licence: str | None = None) -> None:
    """Write the card, as `push_to_hub` would, into the dataset's folder."""
    arguments = card_arguments(root, repo_id, licence)
    card = create_lerobot_dataset_card(dataset_info=load_info(root), repo_id=repo_id, **arguments)
    write_whole(root / CARD, str(card).encode())


def licence_of(root: Path) -> str | None:
    """The licence that a dataset's card names; None if it has no card that can be read, or that names none."""
    try:
        path = regular_file(root, CARD)
        if path.stat().st_size > MAX_CARD_BYTES:
            return None
        _, head, _ = path.read_text(encoding="utf-8").split("---\n", 2)
        licence = yaml.safe_load(head).get("license")
    except (OSError, ValueError, AttributeError, RecursionError, yaml.YAMLError, DatasetError):
        return None
    return licence if isinstance(licence, str) else None
