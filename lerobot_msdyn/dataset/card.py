"""The dataset card of an output: that it is synthetic, from what, by which recipe, with which limits."""

import json
import statistics
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.utils import create_lerobot_dataset_card

from lerobot_msdyn.core.errors import DatasetError
from lerobot_msdyn.core.files import write_whole
from lerobot_msdyn.dataset.checks import regular_file
from lerobot_msdyn.dataset.provenance import PREVIEW, RECIPE, SOURCE_VARIANT, read_column, read_provenance

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
**{rendered} of the {episodes} episodes in this dataset are synthetic.** Their pictures were not recorded: Gaussian
scenes were fitted to recorded episodes and rendered by lerobot_msdyn {version}, as seen from cameras that were moved.
Actions, states, tasks and timestamps are those of the recordings.

{preview}{quality}
### Source

{sources}

`meta/msdyn/episodes.parquet` says for every episode which recording it comes from, which variant it is, and how its
camera was moved; `meta/msdyn/recipe.yaml` is the recipe.{models}

### Limits

* What no frame of a recording shows is filled in from its surroundings.
* Shadows belong to surfaces; where something hid the ground, its shadow is missing.
* Fast and thin things come out ragged.
* Where depth was neither recorded nor measured, things stand on an assumed table plane.
* A policy that is evaluated on rendered pictures has not been evaluated on a camera.

### Splitting for evaluation

All episodes rendered from one recording share its actions. If episodes are held out at random, or by LeRobot's own
`--dataset.eval_split` alone, re-renders of training episodes end up in the evaluation set. Split by recording instead:

```sh
lerobot-train $(python -m lerobot_msdyn.split --root FOLDER) --dataset.repo_id={repo_id} --dataset.root=FOLDER ...
```

<details><summary>Recipe</summary>

```yaml
{recipe}
```

</details>
"""
PREVIEW_TEXT = """\
![Recorded above, rendered below]({path})

*Above: recorded. Below: the same moments, rendered from a moved camera; the view of median expected quality.*

"""


def card_arguments(root: Path, repo_id: str, licence: str | None = None) -> dict[str, Any]:
    """What LeRobot's `push_to_hub` must be given so that the card that it writes says the same.

    `LeRobotDataset(repo_id, root).push_to_hub(**card_arguments(root, repo_id))` uploads all of the folder, meta/msdyn
    included, and writes the card last. Without a licence, the one that the folder's card names is kept.
    """
    rows = read_provenance(root, ("variant", "licences", "version")) or []
    recipe = (root / RECIPE).read_text().strip() if (root / RECIPE).is_file() else "(several; see the parts)"
    rendered = [row for row in rows if row["variant"] != SOURCE_VARIANT]
    count = Counter(row["source_repo_id"] for row in rows)
    models = {name: terms for row in rows for name, terms in json.loads(row.get("licences") or "{}").items()}
    used = "".join(f"\n* {name}: {terms}" for name, terms in sorted(models.items()))
    preview = PREVIEW_TEXT.format(path=PREVIEW.as_posix()) if (root / PREVIEW).is_file() else ""
    description = DESCRIPTION.format(
        preview=preview,
        quality=_quality(root, [row["episode_index"] for row in rendered]),
        rendered=len(rendered),
        episodes=len(rows),
        version=", ".join(sorted({row["version"] for row in rows if row.get("version")})),
        sources="\n".join(f"* {number} episodes made from {name}" for name, number in sorted(count.items())),
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


def _quality(root: Path, rendered: Sequence[int]) -> str:
    """What the gate expected of the new views, by the numbers of their episodes, and where their depth came from."""
    if not rendered:
        return ""
    scores: list[float] = []
    depths: Counter[str] = Counter()
    new = frozenset(rendered)
    columns = (read_column(root, name) for name in ("episode_index", "gate", "priors"))
    for index, gate, priors in zip(*columns, strict=True):
        if index in new:
            views = json.loads(gate or "{}").get("views", {})
            scores += [view["scores"]["expected_db"] for view in views.values() if "scores" in view]
            for prior in json.loads(priors or "{}").values():
                depth = prior.get("depth", {})
                depths[depth.get("model") or depth.get("provider") or "unknown"] += 1
    first = rendered[0]
    of = f"Depth: {', '.join(depths)}." if depths else ""
    said = "The new views were not judged."
    if scores:
        said = (
            f"Expected PSNR of the new views, estimated without a true picture: {min(scores):.1f} dB at worst, "
            f"{statistics.median(scores):.1f} dB in the median, {max(scores):.1f} dB at best (`report.html` has each)."
        )
    return f"### Quality\n\n{said} {of} The first rendered episode is number {first}.\n"


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
