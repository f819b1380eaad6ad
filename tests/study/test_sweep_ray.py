"""A sweep as tasks of a Ray that is started for it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import sweep_runner_for_tests as cheap
from sweep_runner_for_tests import InlineExecutor, a_config

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sweep import ray_executor
from cable_rpc.study.sweep.engine import run_sweep
from cable_rpc.study.sweep.ray_executor import RayExecutor


def test_ray_measures_what_one_process_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six cells that succeed, and two that raise."""
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'cable-rpc[ray]'")
    # Ray's processes find the stand-in for measuring by this.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))
    config = a_config((20, 30, 40, cheap.RAISING_QUALITY))
    run = run_sweep(
        config, tmp_path / "ray" / "run", executor=RayExecutor(workers=2), runner=cheap.measure, preparer=cheap.prepare
    )
    assert not ray.is_initialized()
    inline = run_sweep(
        config, tmp_path / "inline" / "run", executor=InlineExecutor(), runner=cheap.measure, preparer=cheap.prepare
    )
    assert run.missing == 0
    assert [one.error for one in run.cells] == [one.error for one in inline.cells]
    assert [one.error for one in run.cells if one.error] == [f"synthetic:{seed}: the disk is gone" for seed in (1, 2)]
    tables = [(tmp_path / name / "run" / "cells.csv").read_bytes() for name in ("ray", "inline")]
    assert tables[0] == tables[1]


def test_a_missing_ray_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name=name)

    monkeypatch.setattr(ray_executor, "import_module", missing)
    executor = RayExecutor()
    executor.submit(len, "abc")
    with executor, pytest.raises(ConfigurationError, match="pip install"):
        list(executor.completed())


def test_a_ray_without_room_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="0 workers"):
        RayExecutor(workers=0)
