"""Sweeps that are killed, stopped, changed and shared; workers that die, and cells that fail."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import sweep_runner_for_tests as cheap
from rich.console import Console
from sweep_runner_for_tests import InlineExecutor, a_config

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.closed_loop.models import ModelChoice
from cable_rpc.study.sweep import identity
from cable_rpc.study.sweep.cell import ClipRequest
from cable_rpc.study.sweep.cell_run import run_cell
from cable_rpc.study.sweep.config import SweepConfig
from cable_rpc.study.sweep.engine import LOCK_FILE, clips_in_use, run_sweep
from cable_rpc.study.sweep.executors import WORKER_DIED
from cable_rpc.study.sweep.identity import cell_keys
from cable_rpc.study.sweep.local_executor import LocalExecutor
from cable_rpc.study.sweep.progress import SweepProgress
from cable_rpc.study.sweep.run_folder import SweepRun, read_run
from cable_rpc.study.sweep.store import CellStore

QUALITIES = (20, 25, 30, 35)
STRATEGIES = ("cable", "full-frame")
CLIPS_READY = ["planned", "prepared", "prepared"]


@pytest.fixture(autouse=True)
def pinned_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identity, "measuring_code", cheap.pinned_digest)


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "calls.txt"
    path.touch()
    monkeypatch.setenv(cheap.CALLS_VARIABLE, str(path))
    return path


def sweep(config: SweepConfig, folder: Path, *, workers: int = 0) -> SweepRun:
    executor = LocalExecutor(workers) if workers else InlineExecutor()
    return run_sweep(config, folder, executor=executor, runner=cheap.measure, preparer=cheap.prepare)


def cell_calls(path: Path) -> Counter[str]:
    return Counter(line for line in path.read_text().splitlines() if not line.startswith("prepare"))


def all_lines(config: SweepConfig) -> Counter[str]:
    return Counter(cheap.line_of(cell) for cell in config.cells)


def start_child(folder: Path) -> subprocess.Popen[str]:
    program = f"import sweep_runner_for_tests as c; c.sweep_in_child({str(folder)!r}, {QUALITIES})"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent), cheap.SECONDS_VARIABLE: "0.1"}
    # Whoever runs the tests in the background ignores Ctrl-C, which children inherit.
    heed_ctrl_c = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(
        [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True, preexec_fn=heed_ctrl_c
    )


def wait_for(child: subprocess.Popen[str], told: list[str]) -> None:
    assert child.stdout is not None
    assert [child.stdout.readline().strip() for _ in told] == told


@pytest.mark.parametrize(
    "told",
    [["planned"], [*CLIPS_READY, "measured"], [*CLIPS_READY, *(4 * ["measured"])]],
    ids=["before the first clip", "after one cell", "after four cells"],
)
def test_a_killed_sweep_goes_on_where_it_was(told: list[str], tmp_path: Path, calls: Path) -> None:
    """kill -9: what was stored is not measured again, nothing is missing, the tables are those of a whole sweep."""
    config = a_config(QUALITIES)
    child = start_child(tmp_path / "killed")
    wait_for(child, told)
    os.kill(child.pid, signal.SIGKILL)
    # Workers hold the pipe's other end: it is closed when the last of them has gone.
    child.communicate(timeout=20)
    assert json.loads((tmp_path / "killed" / "run" / "run.json").read_text())["finished"] is None
    with CellStore(tmp_path / "killed" / "cells.sqlite") as store:
        stored = store.keys()
    assert told.count("measured") <= len(stored) < len(config.cells)
    keys = cell_keys(config.cells)
    left = [cell for key, cell in zip(keys, config.cells, strict=True) if key not in stored]
    calls.write_text("")
    again = sweep(config, tmp_path / "killed" / "run")
    assert cell_calls(calls) == Counter(map(cheap.line_of, left))
    assert (again.missing, len(again.cells)) == (0, len(config.cells))
    sweep(config, tmp_path / "whole" / "run")
    tables = [(tmp_path / name / "run" / "cells.csv").read_bytes() for name in ("killed", "whole")]
    assert tables[0] == tables[1]
    assert not (tmp_path / "killed" / "clips").exists()


def test_ctrl_c_keeps_what_is_done(tmp_path: Path, calls: Path) -> None:
    child = start_child(tmp_path)
    wait_for(child, [*CLIPS_READY, "measured", "measured"])
    started = time.monotonic()
    child.send_signal(signal.SIGINT)
    child.communicate(timeout=20)
    assert child.returncode != 0
    assert time.monotonic() - started < 15
    stopped = read_run(tmp_path / "run")
    assert 2 <= len(stopped.cells) < 2 * len(QUALITIES)
    assert stopped.missing == 2 * len(QUALITIES) - len(stopped.cells)
    assert stopped.finished == ""
    rows = list(csv.DictReader((tmp_path / "run" / "cells.csv").open()))
    assert [row["key"] for row in rows] == [cell.key for cell in stopped.cells]
    before = len(stopped.cells)
    calls.write_text("")
    assert sweep(a_config(QUALITIES), tmp_path / "run").missing == 0
    assert cell_calls(calls).total() == 2 * len(QUALITIES) - before


def test_a_worker_that_dies_costs_its_cell_only(tmp_path: Path, calls: Path) -> None:
    """Cells that fail, raise, or kill their process; a clip that can't be had; all others are there."""
    bad = (cheap.DEADLY_QUALITY, cheap.RAISING_QUALITY, cheap.FAILING_QUALITY)
    config = a_config((20, *bad, 30), seeds=(1, 404))
    run = sweep(config, tmp_path / "run", workers=2)
    errors = {(one.cell.clip.source, one.cell.rate.quality): one.error for one in run.cells}
    assert run.missing == 0
    assert [errors["synthetic:1", quality] for quality in (20, 30)] == ["", ""]
    assert errors["synthetic:1", cheap.FAILING_QUALITY] == "the encoder failed"
    assert errors["synthetic:1", cheap.RAISING_QUALITY] == "synthetic:1: the disk is gone"
    assert errors["synthetic:1", cheap.DEADLY_QUALITY] == f"synthetic:1: {WORKER_DIED}"
    assert {text for (source, _), text in errors.items() if source.endswith("404")} == {
        "synthetic:404: 'synthetic:404' has no frames"
    }
    made = cell_calls(calls)
    assert made[f"synthetic:1 q{cheap.DEADLY_QUALITY}"] == 2
    assert not any("404" in line for line in made)
    # All that failed is tried again, and nothing else.
    calls.write_text("")
    repaired = a_config((20, cheap.RAISING_QUALITY, cheap.FAILING_QUALITY, 30), seeds=(1,))
    sweep(repaired, tmp_path / "run")
    assert cell_calls(calls) == Counter(f"synthetic:1 q{quality}" for quality in bad[1:])


def test_sweeps_share_cells_under_their_own_labels(tmp_path: Path, calls: Path) -> None:
    """A second sweep over the same store, wider by a quality, with another name for the treatment."""
    first, second = a_config((20, 30)), a_config((20, 30, 40), name="wider", label="black")
    sweep(first, tmp_path / "one")
    assert cell_calls(calls) == all_lines(first)
    calls.write_text("")
    run = sweep(second, tmp_path / "two")
    assert cell_calls(calls) == Counter(["synthetic:1 q40", "synthetic:2 q40"])
    assert [one.cell for one in run.cells] == list(second.cells)
    assert [one.cell for one in read_run(tmp_path / "one").cells] == list(first.cells)
    assert [one.key for one in run.cells] == cell_keys(second.cells)


def test_only_what_changed_is_measured_again(tmp_path: Path, calls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the same; one clip with another segmenter; other code."""
    config = a_config((20, 30))
    sweep(config, tmp_path / "run")
    calls.write_text("")
    sweep(config, tmp_path / "run")
    assert calls.read_text() == ""
    other = ClipRequest("synthetic:2", max_frames=2, models=ModelChoice(segmenter="boxes"))
    changed = tuple(replace(cell, clip=other) if cell.clip.source == other.source else cell for cell in config.cells)
    sweep(replace(config, cells=changed), tmp_path / "run")
    assert calls.read_text().splitlines() == ["prepare synthetic:2", "synthetic:2 q20", "synthetic:2 q30"]
    calls.write_text("")
    monkeypatch.setattr(identity, "measuring_code", lambda: "other code")
    sweep(config, tmp_path / "run")
    assert cell_calls(calls) == all_lines(config)


def test_cells_of_equal_identity_are_measured_once(tmp_path: Path, calls: Path) -> None:
    one, two = a_config((20,), seeds=(1,)), a_config((20,), seeds=(1,), label="again")
    run = sweep(replace(one, cells=one.cells + two.cells), tmp_path / "run")
    assert cell_calls(calls).total() == 1
    assert [cell.cell.treatment_label for cell in run.cells] == ["zero", "again"]


def test_clips_go_with_the_last_sweep_that_uses_them(tmp_path: Path) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    with clips_in_use(clips, keep=False):
        with clips_in_use(clips, keep=False):
            pass
        assert clips.exists()
        assert (tmp_path / LOCK_FILE).exists()
    assert not clips.exists()
    clips.mkdir()
    with clips_in_use(clips, keep=True):
        pass
    assert clips.exists()


def test_real_cells_are_kept_as_they_were_measured(tmp_path: Path) -> None:
    """The loop itself, over two frames, against a direct call; only times may differ."""
    models = ModelChoice(segmenter="boxes", detector="embedded", device="cpu")
    clip = ClipRequest("synthetic:11", size=(160, 96), max_frames=2, models=models)
    config = a_config((28,), seeds=(11,))
    cells = tuple(replace(cell, clip=clip, strategy=strategy) for cell in config.cells for strategy in STRATEGIES)
    run = run_sweep(replace(config, cells=cells), tmp_path / "run", executor=InlineExecutor(), keep_clips=True)
    assert [one.error for one in run.cells] == ["", ""]
    for one in run.cells:
        direct = run_cell(one.cell, tmp_path / "clips")
        assert one.example is not None
        assert one.result is not None
        assert direct.result is not None
        assert (one.result.uplink, one.result.objects) == (direct.result.uplink, direct.result.objects)
        assert (one.example, one.cell.clip) == (direct.example, clip)


def test_a_run_that_cannot_be_read_says_why(tmp_path: Path, calls: Path) -> None:
    with pytest.raises(ConfigurationError, match="no folder of a sweep"):
        read_run(tmp_path)
    sweep(a_config((20,)), tmp_path / "run")
    moved = tmp_path / "elsewhere.sqlite"
    (tmp_path / "cells.sqlite").rename(moved)
    with pytest.raises(ConfigurationError, match="--store"):
        read_run(tmp_path / "run")
    assert read_run(tmp_path / "run", moved).missing == 0
    (tmp_path / "run" / "run.json").write_text('{"schema_version": 99}')
    with pytest.raises(ConfigurationError, match="schema version 99"):
        read_run(tmp_path / "run")


def test_progress_counts_what_was_found_and_what_failed(tmp_path: Path, calls: Path) -> None:
    console = Console(width=200, force_terminal=False, record=True, file=(tmp_path / "log").open("w"))
    sweep(a_config((20,)), tmp_path / "run")
    with SweepProgress(console) as progress:
        run_sweep(
            a_config((20, cheap.FAILING_QUALITY)), tmp_path / "run", executor=InlineExecutor(), listener=progress,
            runner=cheap.measure, preparer=cheap.prepare,
        )  # fmt: skip
    last = console.export_text().strip().splitlines()[-1]
    assert last.startswith("cells 4/4, 2 found, 2 failed, ")
    assert "cells/s, 0:00:00 left" in last
