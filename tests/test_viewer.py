"""The viewer's recording, without a screen."""

import socket
import urllib.request
from pathlib import Path

import pytest

from lerobot_msdyn import viewer
from lerobot_msdyn.core.errors import ConfigError, DatasetError, OutputError

pytest.importorskip("rerun")


@pytest.mark.filterwarnings("ignore:.*is deprecated since 0.32:DeprecationWarning")
def test_a_recording_is_written(desk: Path, desk_scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "episode.rrd"
    source = ["--repo", "local/desk", "--root", str(desk), "--scenes", str(desk_scenes)]
    assert viewer.run([*source, "--episode", "1", "--variants", "1", "--save", str(path)]) == 0
    assert f"open it with: rerun {path}" in capsys.readouterr().out
    from rerun.recording import load_recording

    entities = {column.entity_path for column in load_recording(path).schema().component_columns()}
    for name in (
        "source/video",
        "priors/depth",
        "priors/instances/masks",
        "priors/instances/tracks",
        "world/static",
        "world/moving/points",
        "world/moving/ellipsoids",
        "world/motion/level_0",
        "world/cameras/source",
        "world/cameras/new_0",
        "new_0/rendered",
        "new_0/coverage",
    ):
        assert f"/front/{name}" in entities


def test_bad_input_is_named(desk: Path, desk_scenes: Path, tmp_path: Path) -> None:
    source = ["--repo", "local/desk", "--root", str(desk), "--save", str(tmp_path / "a.rrd")]
    with pytest.raises(ConfigError, match="which dataset"):
        viewer.run([])
    with pytest.raises(DatasetError, match="no saved scene of episode 2"):
        viewer.run([*source, "--scenes", str(desk_scenes), "--episode", "2"])
    with pytest.raises(OutputError, match="no folder"):
        viewer.run([*source, "--save", str(tmp_path / "absent" / "a.rrd")])


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


@pytest.mark.filterwarnings("ignore:.*is deprecated since 0.32:DeprecationWarning")
def test_without_a_display_it_is_served_to_a_browser(
    desk: Path, desk_scenes: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    web, data = free_port(), free_port()
    pages: list[str] = []

    def look() -> None:
        with urllib.request.urlopen(f"http://localhost:{web}/", timeout=30) as page:
            pages.append(page.read().decode())

    monkeypatch.setattr(viewer, "_wait", look)
    source = ["--repo", "local/desk", "--root", str(desk), "--scenes", str(desk_scenes), "--variants", "1"]
    assert viewer.run([*source, "--web_port", str(web), "--data_port", str(data)]) == 0
    assert f"open http://localhost:{web}/?url=rerun" in capsys.readouterr().out
    assert "<html" in pages[0]


@pytest.mark.parametrize("taken", ["--web_port", "--data_port"])
def test_a_taken_port_is_named(taken: str, desk: Path) -> None:
    ports = {"--web_port": free_port(), "--data_port": free_port()}
    with socket.socket() as other:
        other.bind(("", ports[taken]))
        other.listen()
        flags = [text for flag, port in ports.items() for text in (flag, str(port))]
        with pytest.raises(OutputError, match=f"served on port {ports[taken]}: .*--web_port"):
            viewer.run(["--repo", "local/desk", "--root", str(desk), "--web", *flags])
