"""Ask policies many questions at once, and keep the answers in a file that survives the process."""

import json
import os
import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from rover_lib.onboard.policy.load import Policy, load_policy
from rover_lib.onboard.stage import plain

K = TypeVar("K")
P = TypeVar("P")
V = TypeVar("V")


def load_for_cores(artifact: Path, most: int) -> list[Policy]:
    """Load a policy of one thread for each core, `most` at most.

    One policy on all cores would be slower: once torch has a second thread, it spins between inferences, which costs
    several times what it gains for a small policy.
    """
    return [load_policy(artifact, threads=1) for _ in range(min(os.cpu_count() or 1, most))]


def everywhere(policies: Sequence[P], asked: Sequence[K], do: Callable[[P, K], V]) -> Iterator[tuple[K, V]]:
    """Call do(policy, question) for each question on a thread for each policy; yield (question, answer) when ready.

    policies: the same policy, loaded once for each thread. Answers do not depend on how many there are.
    """
    free: queue.SimpleQueue[P] = queue.SimpleQueue()
    for policy in policies:
        free.put(policy)

    def one(question: K) -> tuple[K, V]:
        policy = free.get()
        try:
            return question, do(policy, question)
        finally:
            free.put(policy)

    with ThreadPoolExecutor(max(len(policies), 1)) as pool:
        running = [pool.submit(one, question) for question in asked]
        try:
            for future in as_completed(running):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a file. A line that is torn, because a process was killed, is left out."""
    rows = []
    for line in path.read_text().splitlines() if path.is_file() else ():
        with suppress(ValueError):
            rows.append(json.loads(line))
    return rows


def append_row(path: Path, row: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write("\n" + json.dumps(plain(row)) + "\n")  # starts with a line break, in case the last line was torn
