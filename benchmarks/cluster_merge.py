"""Memory and time of merging many short episodes, as the last step of `lerobot_msdyn.cluster` does it.

python benchmarks/cluster_merge.py --out /tmp/merge [--episodes 1000,2000,4000,10000]

Pictures are tiny and rendering is replaced: one new episode is encoded, and every other one has its files. The source
has one video per camera for 1,000 episodes and one data file, as LeRobot records it. Each size runs in a process of its
own, whose peak of memory is the figure. Exit code 0: the largest takes at most 1.5 GB, and its processor time per
episode is at most twice that of the smallest.
"""

import argparse
import functools
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.video_utils import concatenate_video_files

from lerobot_msdyn.cluster import stages
from lerobot_msdyn.cluster.config import ClusterConfig
from lerobot_msdyn.cluster.plan import job_of
from lerobot_msdyn.cluster.task import Job
from lerobot_msdyn.dataset.provenance import SOURCE_VARIANT, Provenance
from lerobot_msdyn.dataset.read import open_source
from lerobot_msdyn.dataset.staging import FINISHED, Staging
from lerobot_msdyn.dataset.write import NewEpisode, OutputDataset
from lerobot_msdyn.reconstruction.account import Account
from lerobot_msdyn.scene.sources import MovingPixels
from lerobot_msdyn.synthetic import make_scene
from lerobot_msdyn.synthetic.dataset import write_dataset
from lerobot_msdyn.views.gate import HEAT_WIDTH, FrameScores, Scores, record

FRAMES, WIDTH, HEIGHT, FPS = 6, 64, 48, 30
KEY = "observation.images.front"
EACH_FILE = 1000  # episodes in a video file of the source
JUDGED = 6  # frames of a view
MOST_BYTES = 1.5e9
MOST_GROWTH = 2.0  # of the time per episode, from the smallest to the largest size


def write_source(root: Path, episodes: int) -> None:
    """A dataset of many short episodes, all with the pictures of one; their rows differ."""
    small = root.with_name("small")
    shutil.rmtree(small, ignore_errors=True)
    write_dataset([make_scene("push", 0, FRAMES, WIDTH, HEIGHT, FPS)], "local/small", small)
    (clip,) = small.glob(f"videos/{KEY}/*/*.mp4")
    for file in range(-(-episodes // EACH_FILE)):
        path = root / f"videos/{KEY}/chunk-000/file-{file:03d}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        count = min(EACH_FILE, episodes - file * EACH_FILE)
        concatenate_video_files([clip] * count, path)
    shutil.copytree(small / "meta", root / "meta")
    info = json.loads((small / "meta" / "info.json").read_text())
    totals = {"total_episodes": episodes, "total_frames": episodes * FRAMES, "splits": {"train": f"0:{episodes}"}}
    (root / "meta" / "info.json").write_text(json.dumps(info | totals))
    (data,) = small.glob("data/*/*.parquet")
    rows = pq.read_table(data)
    path = root / data.relative_to(small)
    path.parent.mkdir(parents=True)
    with pq.ParquetWriter(path, rows.schema) as writer:
        for index in range(episodes):
            numbers = {"episode_index": [index] * FRAMES, "index": range(index * FRAMES, (index + 1) * FRAMES)}
            shifted = np.array(rows["action"].to_pylist(), np.float32) + np.float32(1e-3 * index)
            writer.write_table(_changed(rows, numbers | {"action": list(shifted)}), row_group_size=FRAMES)
    (table,) = small.glob("meta/episodes/*/*.parquet")
    row = pq.read_table(table)
    places = np.arange(episodes)
    columns: dict[str, Any] = {
        "episode_index": places,
        "dataset_from_index": places * FRAMES,
        "dataset_to_index": (places + 1) * FRAMES,
        f"videos/{KEY}/file_index": places // EACH_FILE,
        f"videos/{KEY}/from_timestamp": (places % EACH_FILE) * FRAMES / FPS,
        f"videos/{KEY}/to_timestamp": (places % EACH_FILE + 1) * FRAMES / FPS,
    }
    many = pa.concat_tables([row] * episodes).combine_chunks()
    pq.write_table(_changed(many, columns), root / table.relative_to(small))
    shutil.rmtree(small)


def _changed(rows: pa.Table, columns: dict[str, Any]) -> pa.Table:
    for name, values in columns.items():
        place = rows.column_names.index(name)
        field = rows.schema.field(place)
        rows = rows.set_column(place, field, [pa.array(list(values), field.type)])
    return rows


def stage_all(output: OutputDataset) -> None:
    """As tasks leave all episodes: the recorded one, copied, and a new one."""
    source = output.source
    pictures = ({KEY: np.full((HEIGHT, WIDTH, 3), 20 * frame, np.uint8)} for frame in range(FRAMES))
    new = output.stage(0, 0, pictures, _provenance(0))
    copied = output.copies(0)
    for index in range(source.total_episodes):
        kept = output.episode(index)
        videos = {}
        for name, staged in (("copied", copied.videos[KEY]), ("variant_00", new.pictures.videos[KEY])):
            videos[name] = kept.folder / name / f"{KEY}.mp4"
            videos[name].parent.mkdir(parents=True, exist_ok=True)
            if not videos[name].exists():
                os.link(staged, videos[name])
        own = replace(copied, videos={KEY: videos["copied"]})
        made = replace(new.pictures, videos={KEY: videos["variant_00"]})
        recorded = NewEpisode(index, Provenance("local/many", index, SOURCE_VARIANT, 0))
        rendered = NewEpisode(index, _provenance(index), made, seconds={"judging": 0.1, f"fitting {KEY}": 1.0})
        kept.keep("copied", functools.partial(_same, own))
        kept.keep(FINISHED, functools.partial(_same, [recorded, rendered]))


def _same(value: Any) -> Any:
    return value


def _provenance(index: int) -> Provenance:
    """The record of a view that was judged."""
    account = Account(MovingPixels(900, 50, 50, 10), 0.01, 0.02, held_out=False).entry()
    frames = [FrameScores(frame, 25.0, 0.01, 4.0, 1.0) for frame in range(JUDGED)]
    causes = {"video": 1e-3, "geometry": 2e-3, "depth": 0.0, "sampling": 1e-4}
    heat = [[column % 7 for column in range(HEAT_WIDTH)] for _ in range(HEAT_WIDTH * HEIGHT // WIDTH)]
    quality, nearby = (25.0 + 1e-3 * index, causes, 24.0, 0.9, 20.0, 30.0, 0.9, 0.05, 0.05), (0.01, 4.0, 1.0, 1.0, 1.0)
    scores = record(Scores(*quality, True, *nearby, frames, heat))
    view = {"distance_m": 0.8, "what_moves": account, "scores": scores, "defects": []}
    priors = {name: {"provider": "made up", "why": "a benchmark"} for name in ("depth", "masks", "tracks", "camera")}
    pose = {"K": np.eye(3).tolist(), "camera_from_source": np.eye(4).tolist()}
    amounts = {"azimuth_deg": 1e-3 * index, "elevation_deg": 2.0}
    gate = {"views": {KEY: view}, "rejected": []}
    return Provenance("local/many", index, 0, 0, {KEY: amounts}, {KEY: priors}, {KEY: pose}, gate)


def job_for(out: Path, episodes: int) -> Job:
    """The job of so many."""
    new_root = out / f"merged_{episodes}"
    config = ClusterConfig(repo_id="local/many", root=out / "source", new_root=new_root, variants=1, tasks=4)
    config.scene = replace(config.scene, shared_background=False)
    config.gate = replace(config.gate, enabled=False)
    return job_of(config)


def measure(job: Job, episodes: int) -> dict[str, float]:
    """Merge so many; returns seconds (by the clock and of the processor) and the peak of memory of this process."""
    start, start_cpu = time.perf_counter(), time.process_time()
    stages.merge(job)
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - start_cpu
    files = list((Path(job.new_root) / "videos").rglob("*.mp4"))
    return {
        "episodes": episodes,
        "seconds": round(seconds, 1),
        "cpu_s": round(cpu_s, 1),
        "cpu_ms_per_episode": round(1e3 * cpu_s / episodes, 2),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
        "video_files": len(files),
    }


def prepare(job: Job, episodes: int) -> None:
    """What comes before the merge."""
    source_root, new_root = Path(job.settings["root"]), Path(job.new_root)
    write_source(source_root, episodes)
    job.write()
    stages.background(job)
    source = open_source("local/many", source_root)
    stage_all(OutputDataset(source, job.new_repo_id, new_root, Staging(new_root, lock=False), replaces=True))


def main() -> int:
    """Print a line of JSON per size; 0 if the limits are kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="a folder that is made, and removed before")
    parser.add_argument("--episodes", default="1000,2000,4000,10000")
    parser.add_argument("--one", choices=("prepare", "merge"), help="do only this, in this process")
    options = parser.parse_args()
    sizes = [int(size) for size in options.episodes.split(",")]
    if options.one == "prepare":
        prepare(job_for(options.out, sizes[0]), sizes[0])
        return 0
    if options.one == "merge":
        print(json.dumps(measure(job_for(options.out, sizes[0]), sizes[0])))
        return 0
    figures = []
    for size in sizes:
        shutil.rmtree(options.out, ignore_errors=True)
        options.out.mkdir(parents=True)
        for part in ("prepare", "merge"):
            command = [sys.executable, __file__, "--out", str(options.out), "--episodes", str(size), "--one", part]
            said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
        figures.append(json.loads(said.splitlines()[-1]))
        print(json.dumps(figures[-1]), flush=True)
    grown = figures[-1]["cpu_ms_per_episode"] / figures[0]["cpu_ms_per_episode"]
    return int(figures[-1]["peak_mb"] * 1e6 > MOST_BYTES or grown > MOST_GROWTH)


if __name__ == "__main__":
    sys.exit(main())
