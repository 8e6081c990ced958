"""The progress bar: when it begins to tell the time left, and which."""

import io

import pytest

from lerobot_msdyn.augment.progress import UNWATCHED_S, EpisodeBar


def bar_after(elapsed_s: float, total: int, *shares: float) -> str:
    """A bar as it is shown so long after its start, when some shares of episodes are done."""
    with EpisodeBar(total, io.StringIO()) as bar:
        bar.begin("fitting")
        bar.start_t -= elapsed_s
        for share in shares:
            bar.advance(share)
        return str(bar)


def test_no_time_left_is_told_before_a_twentieth_is_done() -> None:
    text = bar_after(60, 8, 0.2, 0.19)
    assert text.startswith("fitting |")
    assert text.endswith("5 % of 8 episodes [01:00]")


def test_then_it_is_told_by_the_average_since_the_start() -> None:
    """A fast last part, as of an episode that was finished before, does not promise the rest as fast."""
    assert bar_after(60, 8, 0.1, 0.7).endswith(" 10 % of 8 episodes [01:00<09:00]")
    assert bar_after(60, 8, *[0.001] * 800).endswith(" 10 % of 8 episodes [01:00<09:00]")


def test_work_before_the_episodes_counts() -> None:
    with EpisodeBar(4, io.StringIO(), what="looking at the background", before=1.0) as bar:
        bar.start_t -= 60
        bar.advance(0.5)
        assert " 10 % of 4 episodes [01:00<09:00]" in str(bar)
        bar.advance(4.5)
        assert "100 % of 4 episodes" in str(bar)


def test_shares_that_add_up_to_more_end_at_the_total() -> None:
    assert bar_after(60, 1, 0.7, 0.7).endswith("100 % of 1 episodes [01:00<00:00]")


@pytest.mark.parametrize("watched", [True, False])
def test_a_file_gets_few_lines(watched: bool) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return watched

    stream = Terminal()
    with EpisodeBar(4, stream) as bar:
        written = stream.getvalue()
        bar.begin("fitting")
        assert ("fitting" in stream.getvalue().removeprefix(written)) == watched


def test_a_file_is_told_of_a_stage_that_begins_long_after_the_last_line() -> None:
    stream = io.StringIO()
    with EpisodeBar(4, stream, what="looking at the background") as bar:
        assert stream.getvalue().strip().startswith("looking at the background |")
        bar.begin("background: reading episode 3")
        assert "reading" not in stream.getvalue()
        bar.last_print_t -= UNWATCHED_S
        bar.begin("background: reading episode 4")
        bar.begin("background: reading episode 5")
        assert "reading episode 4" in stream.getvalue()
        assert "reading episode 5" not in stream.getvalue()
