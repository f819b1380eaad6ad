"""A few minutes of the soak, of which `python benchmarks/soak.py` runs the half hour; and that it sees faults."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def benchmarks(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(repository / "benchmarks"))


def ledger(folder: Path, *events: str) -> Path:
    path = folder / f"{len(list(folder.iterdir()))}.ledger"
    path.write_text("".join(f"{event}\n" for event in events))
    return path


@pytest.mark.usefixtures("benchmarks")
def test_books_tell_what_was_lost(tmp_path: Path) -> None:
    from soak_runs import read_books

    good = ledger(tmp_path, "o", "s 0", "a 0", "s 1", "s 2", "r 1 SUPERSEDED", "a 2", "g", "o", "s 0", "a 0", "g")
    killed = ledger(tmp_path, "o", "s 0", "s 1", "a 0")
    never = ledger(tmp_path, "o", "s 0", "g")
    twice = ledger(tmp_path, "o", "s 0", "a 0", "a 0", "g")
    broken = ledger(tmp_path, "o", "s 0", "x RemoteError gone")
    books = read_books([good])
    assert (books.sessions, books.goodbyes, books.sent, books.answered) == (2, 2, 4, 3)
    assert books.rejected == {"SUPERSEDED": 1}
    assert (books.unanswered, books.twice, books.lost_in_killed, books.broken) == (0, 0, 0, {})
    books = read_books([good, killed, never, twice, broken])
    assert (books.unanswered, books.twice, books.lost_in_killed, books.most_lost) == (1, 1, 2, 1)
    assert books.broken == {"RemoteError gone": 1}


@pytest.mark.usefixtures("benchmarks")
def test_slope_finds_a_leak_in_noise() -> None:
    from soak import slope

    seconds = np.arange(1200)
    noise = np.random.default_rng(0).normal(0.0, 2.0, len(seconds))
    rate, error = slope(list(200.0 + 1.5 * seconds / 60.0 + noise))
    assert rate == pytest.approx(1.5, abs=4.0 * error)
    # Independent noise of the samples: sigma / sqrt(sum of squared distances from the mean).
    assert error == pytest.approx(2.0 / np.sqrt(((seconds - seconds.mean()) ** 2).sum() / 3600.0), rel=0.3)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_clients_that_come_go_and_die_leave_nothing_behind(repository: Path, tmp_path: Path) -> None:
    """Memory still settles in the first minutes, hence the long warm-up; the slope is that of the rest."""
    report = tmp_path / "soak.json"
    command = [sys.executable, str(repository / "benchmarks" / "soak.py"), "--minutes", "4", "--warm-up", "2"]
    paths = os.pathsep.join(str(repository / folder) for folder in (".", "codecs", "models"))
    subprocess.run(
        [*command, "--out", str(report)], env=os.environ | {"PYTHONPATH": paths}, check=False, capture_output=True
    )
    found: dict[str, Any] = json.loads(report.read_text())
    assert found["faults"] == []
    assert found["frames"]["answered"] > 1000
    assert found["events"]["killed"] > 10
