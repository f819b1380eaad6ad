"""`cable-rpc sweep` as a person meets it."""

from __future__ import annotations

import csv
import sqlite3
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cable_rpc.cli.app import app
from cable_rpc.errors import ConfigurationError

for needed in ("yaml", "scipy", "onnxruntime", "torch"):
    pytest.importorskip(needed, reason=f"needs {needed}, in the cloud and study extras")

TINY = ["--data", "synthetic:11", "--size", "160x96", "--max-frames", "4", "--segmenter", "boxes"]


def invoke(*arguments: str, code: int = 0) -> tuple[str, str]:
    """Runs the command in this process; its own errors pass through."""
    done = CliRunner().invoke(app, ["sweep", *arguments], catch_exceptions=False)
    assert done.exit_code == code, done.output
    return done.stdout, done.stderr


def test_a_sweep_is_planned_run_and_taken_up_again(tmp_path: Path) -> None:
    store, out = tmp_path / "cells.sqlite", tmp_path / "first"
    command = [*TINY, "--quality", "24,36", "--workers", "1", "--out", str(out), "--no-report"]
    planned, _ = invoke(*command, "--dry-run")
    assert "no estimate before some are done" in planned
    assert not store.exists()
    shown, told = invoke(*command)
    assert "cable · default · h264" in shown
    assert "the anchor has 2 points; a BD-rate needs 5" in told
    rows = list(csv.DictReader((out / "cells.csv").read_text().splitlines()))
    assert len(rows) == 4
    assert not (tmp_path / "clips").exists()
    before = stored(store)
    assert len(before) == 4
    again, told = invoke(*command)
    assert again == shown
    assert "cells 4/4, 4 found" in told
    wider = [*TINY, "--quality", "24,30", "--out", str(tmp_path / "second"), "--no-report"]
    planned, _ = invoke(*wider, "--dry-run")
    assert [line.split("│")[2].strip() for line in planned.splitlines() if "done" in line or "to do" in line] == [
        "2",
        "2",
    ]
    assert "with 2 workers, at" in planned
    assert stored(store) == before


def stored(path: Path) -> list[tuple[str, str]]:
    """Keys and times of writing."""
    connection = sqlite3.connect(path)
    try:
        return connection.execute("SELECT key, written FROM cells ORDER BY key").fetchall()
    finally:
        connection.close()


def test_a_sweep_in_which_everything_fails_says_why(tmp_path: Path) -> None:
    _, told = invoke("--data", "video:nowhere.mp4", "--quality", "30", "--out", str(tmp_path / "run"), code=1)
    assert "2 of 2 cells failed; the same command tries them again" in told
    assert "nowhere.mp4" in told
    assert (tmp_path / "run" / "cells.csv").is_file()


def test_ctrl_c_says_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("cable_rpc.study.sweep.engine.run_sweep", stop)
    _, told = invoke(*TINY, "--out", str(tmp_path / "run"), code=130)
    assert f"stopped; 0 of 10 cells are kept in {tmp_path / 'cells.sqlite'}" in told
    assert "the same command goes on from there" in told


def test_help_teaches() -> None:
    shown, _ = invoke("--help")
    assert "Example: cable-rpc sweep --data video:drive.mp4" in " ".join(shown.split())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "needs a configuration, or --data"),
        ([*TINY, "--engine", "slurm"], "--engine is 'slurm'; use local or ray"),
        ([*TINY, "--engine", "ray", "--cpus-per-cell", "0"], "more than 0 CPUs"),
        ([*TINY, "--strategy", "cabel"], "sweep: grids[0].strategies[0] is 'cabel'; give one of cable"),
        (["nowhere.yaml"], "can't read the sweep's configuration nowhere.yaml"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_misuse_is_told(arguments: list[str], said: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        invoke(*arguments)
    assert said in str(raised.value)
