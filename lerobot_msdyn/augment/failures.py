"""Why episodes failed, in a line per reason: a file that many episodes lie in is named once, with all of them."""

import re
from collections.abc import Iterable, Mapping

STANDING_NUMBER = re.compile(r"(?<![\w./-])\d+(\.\d+)?(?![\w/-])")  # none of a path


def same_reason(repo_id: str, index: int, message: str) -> str:
    """What messages have in common that say the same of other episodes: without the episode and without numbers."""
    return STANDING_NUMBER.sub("#", message.removeprefix(f"{repo_id} episode {index}"))


def one_line_each(repo_id: str, failures: Mapping[int, str]) -> list[str]:
    """One line per reason, with all episodes that failed for it.

    Args:
        repo_id: the dataset, by which messages begin: "local/ds episode 3: ...".
        failures: episode -> message.
    """
    groups: dict[str, list[int]] = {}
    for index, message in failures.items():
        groups.setdefault(same_reason(repo_id, index, message), []).append(index)
    return [_line(repo_id, indices, failures) for indices in groups.values()]


def _line(repo_id: str, indices: list[int], failures: Mapping[int, str]) -> str:
    first = indices[0]
    if len(indices) == 1:
        return failures[first]
    rests = [failures[index].removeprefix(f"{repo_id} episode {index}") for index in indices]
    numbers = "" if len(set(rests)) == 1 else f" (numbers: those of episode {first})"
    return f"{repo_id} episodes {ranges(indices)}{rests[0]}{numbers}"


def ranges(numbers: Iterable[int]) -> str:
    """Numbers in words, runs by their ends: "0 to 3, 7"."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(low) if low == high else f"{low} to {high}" for low, high in runs)
