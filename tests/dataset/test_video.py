"""Video files: frames in, the same number of frames out, cut without loss."""

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import DepthEncoderConfig, RGBEncoderConfig
from lerobot.datasets.video_utils import concatenate_video_files, decode_video_frames

from lerobot_msdyn.core.errors import EpisodeError, OutputError
from lerobot_msdyn.dataset import video
from lerobot_msdyn.dataset.video import VideoFile, cut_video, encoder_of, frame_times, nvenc_of
from lerobot_msdyn.dataset.video_index import index_of

FPS = 10


def frames(count: int, shade: int = 0) -> np.ndarray:
    """Frame i is grey of value shade + 10 i."""
    values = shade + 10 * np.arange(count, dtype=np.uint8)
    return np.broadcast_to(values[:, None, None, None], (count, 48, 64, 3)).copy()


def encode_video(pictures: np.ndarray, path: Path, encoder: RGBEncoderConfig) -> None:
    with VideoFile(path, FPS, encoder) as file:
        for picture in pictures:
            file.add(picture)


def decode(path: Path, count: int) -> torch.Tensor:
    return decode_video_frames(path, [i / FPS for i in range(count)], 1e-4, "pyav", return_uint8=True)


@pytest.fixture(params=["libsvtav1", "h264"])
def encoder(request: pytest.FixtureRequest) -> RGBEncoderConfig:
    return RGBEncoderConfig(vcodec=request.param)


def test_encoded_frames_come_back(tmp_path: Path, encoder: RGBEncoderConfig) -> None:
    path = tmp_path / "a.mp4"
    encode_video(frames(7), path, encoder)
    assert frame_times(path) == [Fraction(i, FPS) for i in range(7)]
    shades = decode(path, 7).float().mean((1, 2, 3))
    assert (shades - torch.arange(7) * 10).abs().max() < 4


@pytest.mark.parametrize(("start", "count"), [(0, 5), (5, 4), (9, 6)])
def test_an_episode_is_cut_out_of_a_shared_file(
    tmp_path: Path, encoder: RGBEncoderConfig, start: int, count: int
) -> None:
    parts = []
    for i, length in enumerate((5, 4, 6)):
        parts.append(tmp_path / f"{i}.mp4")
        encode_video(frames(length, 60 * i), parts[-1], encoder)
    shared, cut = tmp_path / "shared.mp4", tmp_path / "cut.mp4"
    concatenate_video_files(parts, shared)
    cut_video(index_of(shared), range(start, start + count), FPS, lambda: encoder, cut)
    assert frame_times(cut) == [Fraction(i, FPS) for i in range(count)]
    assert torch.equal(decode(cut, count), decode(shared, 15)[start : start + count])


def test_a_cut_between_key_frames_is_encoded_anew(tmp_path: Path) -> None:
    encoder = RGBEncoderConfig(vcodec="h264", g=100)
    encode_video(frames(12), tmp_path / "a.mp4", encoder)
    cut_video(index_of(tmp_path / "a.mp4"), range(5, 9), FPS, lambda: encoder, tmp_path / "cut.mp4")
    shades = decode(tmp_path / "cut.mp4", 4).float().mean((1, 2, 3))
    assert (shades - torch.tensor([50, 60, 70, 80])).abs().max() < 5


def test_frames_that_are_not_there(tmp_path: Path, encoder: RGBEncoderConfig) -> None:
    encode_video(frames(5), tmp_path / "a.mp4", encoder)
    with pytest.raises(EpisodeError, match=r"a\.mp4: its frames cannot be copied"):
        cut_video(index_of(tmp_path / "a.mp4"), range(3, 7), FPS, lambda: encoder, tmp_path / "cut.mp4")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="SVT-AV1 asks for it as root alone")
def test_the_av1_encoder_leaves_no_thread_in_real_time(tmp_path: Path) -> None:
    with VideoFile(tmp_path / "a.mp4", FPS, RGBEncoderConfig(vcodec="libsvtav1")) as file:
        for picture in frames(2):
            file.add(picture)
            threads = {int(thread): os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")}
            assert set(threads.values()) == {os.SCHED_OTHER}


def test_encoder_is_the_sources() -> None:
    feature = {"info": {"video.codec": "h264", "video.pix_fmt": "yuv444p", "video.crf": 18, "video.g": 5}}
    encoder = encoder_of(feature, "front")
    assert (encoder.vcodec, encoder.pix_fmt, encoder.crf, encoder.g) == ("h264", "yuv444p", 18, 5)
    assert encoder_of({}, "front").vcodec == "libsvtav1"
    with pytest.raises(OutputError, match="front: cannot encode video like its source"):
        encoder_of({"info": {"video.codec": "vp9"}}, "front")


def test_a_gpu_encodes_what_lerobot_has_settings_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_can_encode", lambda name: True)
    given = RGBEncoderConfig(vcodec="h264", crf=18, g=5, preset="slow")
    on_gpu = nvenc_of(given)
    assert (on_gpu.vcodec, on_gpu.pix_fmt, on_gpu.g) == ("h264_nvenc", given.pix_fmt, 5)
    assert on_gpu.get_codec_options()["qp"] == 18
    for other in (RGBEncoderConfig(vcodec="libsvtav1"), DepthEncoderConfig()):
        assert nvenc_of(other) is other
    monkeypatch.setattr(video, "_can_encode", lambda name: False)
    assert nvenc_of(given) is given


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_nvenc_is_not_used(caplog: pytest.LogCaptureFixture) -> None:
    video._can_encode.cache_clear()
    given = RGBEncoderConfig(vcodec="h264")
    with caplog.at_level("WARNING"):
        assert nvenc_of(given) is given
        assert nvenc_of(given) is given
    assert [record.getMessage()[:30] for record in caplog.records] == ["h264_nvenc cannot be used here"]


@pytest.mark.parametrize("params", ["", "lossless=1", "lossless=1:log-level=info"])
def test_x265_writes_nothing_that_was_not_asked_for(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], params: str
) -> None:
    encoder = DepthEncoderConfig(vcodec="hevc", extra_options={"x265-params": params} if params else {})
    depth = np.full((3, 48, 64), 0.5, np.float32)
    with VideoFile(tmp_path / "depth.mp4", FPS, encoder) as file:
        for picture in depth:
            file.add(picture)
    assert ("x265 [info]" in capfd.readouterr().err) == ("info" in params)
