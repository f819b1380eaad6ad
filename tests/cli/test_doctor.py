"""The doctor on this machine, and its verdicts on machines that lack something."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version

import pytest
from cable_codecs import CodecProbe
from rich.console import Console

from cable_rpc.cli.doctor import in_rows, render_report
from cable_rpc.cli.machine import (
    BackEnd,
    Extra,
    Hardware,
    MachineReport,
    Requirement,
    Verdict,
    judge_cloud,
    judge_edge,
    judge_study,
    parse_memory,
    recent_enough,
    requirements_of,
)

H264 = CodecProbe("h264", "libx264", False, True, None, "h264")
NVENC = CodecProbe("h264", "h264_nvenc", True, False, "h264_nvenc doesn't open here: it needs a GPU", "h264")
JPEG = CodecProbe("jpeg", "opencv", False, True, None, "mjpeg")
CODECS = (JPEG, H264, NVENC)
BACK_ENDS = (BackEnd("detector", "embedded", "m", "p"), BackEnd("segmenter", "boxes", "m", "p"))
CPU = ("CPUExecutionProvider",)
COMPLETE = tuple(Extra(name, (Requirement(name, "", "1", True),)) for name in ("base", "cloud", "study"))
READY = Verdict("edge", "ready", "")


def lacking(extra: str, package: str) -> tuple[Extra, ...]:
    absent = Extra(extra, (Requirement(package, ">=2", None, False),))
    return tuple(absent if known.name == extra else known for known in COMPLETE)


@pytest.fixture(scope="module")
def report() -> dict[str, object]:
    done = subprocess.run(
        [sys.executable, "-m", "cable_rpc", "doctor", "--json"], capture_output=True, text=True, check=False, timeout=90
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_json_tells_what_is_installed(report: dict[str, object]) -> None:
    versions = report["versions"]
    assert isinstance(versions, dict)
    assert versions["av"] == version("av")
    assert versions["numpy"] == version("numpy")
    assert versions["libavcodec"].split(".")[0].isdecimal()
    codecs = report["codecs"]
    assert isinstance(codecs, list)
    assert {"h264", "jpeg"} <= {probe["codec"] for probe in codecs}
    assert all(probe["usable"] or probe["reason"] for probe in codecs)
    verdicts = report["verdicts"]
    assert isinstance(verdicts, list)
    assert [verdict["role"] for verdict in verdicts] == ["edge", "cloud", "study"]
    assert verdicts[0]["state"] == "ready"


def test_looking_imports_no_torch() -> None:
    code = (
        "import sys; from cable_rpc.cli.machine import examine_machine; examine_machine(); "
        "sys.exit(any(name in sys.modules for name in ('torch', 'transformers')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=90).returncode == 0


def test_edge() -> None:
    assert judge_edge(CODECS, COMPLETE).state == "ready"
    only_stills = judge_edge((JPEG, replace(H264, usable=False)), COMPLETE)
    assert only_stills.state == "partly"
    assert any("--codec jpeg" in remedy for remedy in only_stills.remedies)
    assert judge_edge([replace(probe, usable=False) for probe in CODECS], COMPLETE).state == "missing"
    old = judge_edge(CODECS, lacking("base", "av"))
    assert old.state == "missing"
    assert "av>=2" in old.reason
    hardware = judge_edge((*CODECS[:2], replace(NVENC, usable=True, reason=None)), COMPLETE)
    assert "h264_nvenc" in hardware.reason
    assert "libx264" in hardware.reason


def test_cloud() -> None:
    assert judge_cloud(CODECS, COMPLETE, BACK_ENDS, CPU).state == "ready"
    for codecs, extras, back_ends, providers in (
        (CODECS, COMPLETE, BACK_ENDS, ()),
        (CODECS, COMPLETE, BACK_ENDS[:1], CPU),
        (CODECS, (), BACK_ENDS, CPU),
        ([replace(probe, decoder=None) for probe in CODECS], COMPLETE, BACK_ENDS, CPU),
    ):
        verdict = judge_cloud(codecs, extras, back_ends, providers)
        assert verdict.state == "missing"
        assert verdict.remedies
    without_torch = judge_cloud(CODECS, lacking("cloud", "torch"), BACK_ENDS, CPU)
    assert without_torch.state == "partly"
    assert "language-model" in without_torch.reason


def test_study() -> None:
    assert judge_study(READY, READY, COMPLETE).state == "ready"
    assert judge_study(READY, READY, lacking("study", "plotly")).state == "missing"
    no_cloud = judge_study(READY, Verdict("cloud", "missing", ""), COMPLETE)
    assert no_cloud.state == "partly"
    assert "cloud" in no_cloud.reason


def test_requirements_by_extra() -> None:
    lines = [
        "numpy>=2.0",
        'never-heard-of>=1; extra == "ray"',
        'pytest[toml]>=999; python_version >= "3.11" and extra == "dev"',
        "rich",
    ]
    base = requirements_of(lines, "base")
    assert [(entry.package, entry.wanted, entry.satisfied) for entry in base] == [
        ("numpy", ">=2.0", True),
        ("rich", "", True),
    ]
    (absent,) = requirements_of(lines, "ray")
    assert (absent.package, absent.installed, absent.satisfied) == ("never-heard-of", None, False)
    (old,) = requirements_of(lines, "dev")
    assert old.installed == version("pytest")
    assert not old.satisfied


@pytest.mark.parametrize(
    ("found", "wanted", "enough"),
    [("1.20", ">=1.20.0", True), ("1.9", ">=1.20", False), ("2.13.0+cpu", ">=2.6,<3", True), ("5.0.0rc1", "", True)],
)
def test_lower_bounds(found: str, wanted: str, enough: bool) -> None:
    assert recent_enough(found, wanted) == enough


def test_memory_in_bytes() -> None:
    text = "MemTotal:       16384 kB\nMemAvailable:    1024 kB\nHugePages_Total:       0\n"
    assert parse_memory(text) == {"MemTotal": 2**24, "MemAvailable": 2**20}


@pytest.mark.parametrize("width", [80, 120])
def test_tables_fit_and_keep_brackets(width: int) -> None:
    machine = MachineReport(
        versions={"cable-rpc": "1", "torch": None, "FFmpeg": "8", "libavcodec": "62.1.2", "libswscale": "9.1.2"},
        codecs=(*CODECS, *(replace(NVENC, encoder=f"vendor{i}_encoder", reason="broken") for i in range(9))),
        back_ends=BACK_ENDS,
        inference_providers=(),
        extras=(*lacking("cloud", "torch"), Extra("trial", ())),
        hardware=Hardware("Linux", 8, 4, 2, None, None, False),
        verdicts=(READY, judge_cloud(CODECS, COMPLETE, BACK_ENDS, ())),
    )
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(render_report(machine))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= width
    assert "pip install 'cable-rpc[cloud]'" in text
    assert "needs a GPU" in text
    assert "4 for this process" in text
    assert "…" not in text


def test_rows_hold_every_name_once() -> None:
    names = ["alpha", "beta", "a-name-longer-than-a-row", "gamma"]
    rows = list(in_rows(names, 12))
    assert ", ".join(row.rstrip(",") for row in rows).split(", ") == names
    assert list(in_rows([], 12)) == []
