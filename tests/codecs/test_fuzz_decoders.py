"""Thousands of damaged packets for every decoder: no crash, no hang, no memory bomb, and it works on afterwards."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from cable_codecs import available_codecs

WORKER = Path(__file__).with_name("fuzz_worker.py")
MOST_GROWTH = 48 << 20
TARGETS = (*available_codecs(), "mask")


def fuzz(target: str, seed: int, series: int, timeout_s: float) -> dict[str, object]:
    """The worker's report; a crash, a hang or an exhausted memory limit fails the test."""
    command = [sys.executable, "-X", "faulthandler", str(WORKER), target, str(seed), str(series)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert done.returncode == 0, f"exit status {done.returncode}: {done.stderr[-3000:]}"
    report: dict[str, object] = json.loads(done.stdout)
    assert report["defects"] == []
    assert report["growth"] < MOST_GROWTH
    assert report["refused"]
    assert report["decoded"]
    return report


@pytest.mark.parametrize("target", TARGETS)
def test_damaged_packets(target):
    fuzz(target, seed=1, series=300 if target == "mask" else 25, timeout_s=60)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("target", TARGETS)
def test_many_damaged_packets(target):
    for seed in range(2, 5):
        fuzz(target, seed, series=6000 if target == "mask" else 700, timeout_s=280)
