"""On what a sweep ran, for people."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import av

import cable_rpc
from cable_rpc.study.sweep.identity import measuring_code

PACKAGES = ("numpy", "opencv-python-headless", "av", "onnxruntime", "torch", "transformers", "ray")
CPU_FILE = Path("/proc/cpuinfo")


def environment() -> dict[str, str]:
    """Versions, system, processor and the digest of the measuring code; what isn't installed is left out."""
    found = {
        "cable-rpc": cable_rpc.__version__,
        "measuring code": measuring_code(),
        "python": platform.python_version(),
    }
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found | {
        "FFmpeg": str(av.ffmpeg_version_info),
        "system": f"{platform.system()} {platform.release()}",
        "processor": processor(),
        "cores": str(os.cpu_count()),
    }


def processor() -> str:
    """Its name where the system tells, otherwise its architecture."""
    try:
        lines = CPU_FILE.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.machine()
