"""Why episodes failed: a line per reason."""

from lerobot_msdyn.augment.failures import one_line_each, ranges


def test_one_absent_file_is_one_line() -> None:
    file = "/data/2024/ds/videos/front/chunk-000/file-001.mp4"
    failures = {index: f"local/ds episode {index}: {file} is absent" for index in (*range(5, 55), 60)}
    failures[3] = "local/ds episode 3: /data/2024/ds/videos/front/chunk-000/file-002.mp4 is absent"
    assert one_line_each("local/ds", failures) == [
        f"local/ds episodes 5 to 54, 60: {file} is absent",
        failures[3],
    ]


def test_reasons_that_differ_in_numbers_alone() -> None:
    failures = {i: f"local/ds episode {i}, front: /x/file-000.mp4 has no {10 + i} frames (eof)" for i in (1, 2)}
    (line,) = one_line_each("local/ds", failures)
    assert line == (
        "local/ds episodes 1 to 2, front: /x/file-000.mp4 has no 11 frames (eof) (numbers: those of episode 1)"
    )
    assert one_line_each("local/ds", {}) == []


def test_ranges() -> None:
    assert ranges([7, 0, 1, 2]) == "0 to 2, 7"
