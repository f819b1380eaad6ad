"""What this machine can do: facts, and a verdict for each role; nothing is installed, loaded or changed."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, entry_points, version
from pathlib import Path
from typing import Literal

import av
import cv2
from cable_codecs import CodecProbe, probe_codecs

import cable_rpc

PACKAGE = "cable-rpc"
DEFAULT_CODEC = "h264"
VERSIONED = (
    "av",
    "opencv-python-headless",
    "numpy",
    "grpcio",
    "protobuf",
    "onnxruntime",
    "torch",
    "transformers",
)
STAND_INS = {
    "onnxruntime": ("onnxruntime-gpu", "onnxruntime-directml", "onnxruntime-openvino"),
    "opencv-python-headless": ("opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
}
"""Other packages that bring the same module."""
LIBRARIES = ("libavcodec", "libavformat", "libavutil", "libswscale")
BACK_END_KINDS = ("detector", "segmenter")
LANGUAGE_MODEL_PACKAGES = ("torch", "transformers", "safetensors")
NVIDIA_DRIVER = Path("/proc/driver/nvidia/version")
MEMORY_FILE = Path("/proc/meminfo")

State = Literal["ready", "partly", "missing"]


@dataclass(frozen=True, slots=True)
class Requirement:
    """One package that an extra asks for."""

    package: str
    wanted: str
    """Version specifier as the metadata has it, e.g. ``>=1.20``."""
    installed: str | None
    satisfied: bool


@dataclass(frozen=True, slots=True)
class Extra:
    """An optional part of the package; ``base`` is what is always installed."""

    name: str
    requirements: tuple[Requirement, ...]

    @property
    def missing(self) -> tuple[Requirement, ...]:
        """Absent or too old."""
        return tuple(requirement for requirement in self.requirements if not requirement.satisfied)

    @property
    def command(self) -> str:
        """What installs it."""
        return "pip install cable-rpc" if self.name == "base" else f"pip install 'cable-rpc[{self.name}]'"


@dataclass(frozen=True, slots=True)
class BackEnd:
    """A registered detector or segmenter; that it is registered doesn't say that its model loads."""

    kind: str
    name: str
    module: str
    package: str


@dataclass(frozen=True, slots=True)
class Hardware:
    """What the work runs on."""

    system: str
    cpu_count: int
    usable_cpus: int
    """Those that this process may run on."""
    opencv_threads: int
    memory_bytes: int | None
    available_memory_bytes: int | None
    nvidia_driver: bool


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether this machine can take a role."""

    role: str
    state: State
    reason: str
    remedies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class MachineReport:
    """All of it."""

    versions: dict[str, str | None]
    codecs: tuple[CodecProbe, ...]
    back_ends: tuple[BackEnd, ...]
    inference_providers: tuple[str, ...]
    """ONNX Runtime's execution providers, best first; empty without it."""
    extras: tuple[Extra, ...]
    hardware: Hardware
    verdicts: tuple[Verdict, ...]


def examine_machine() -> MachineReport:
    """Looks at everything; takes a second or two, most of it for opening encoders."""
    codecs = tuple(probe_codecs())
    back_ends = find_back_ends()
    extras = find_extras()
    providers = inference_providers()
    edge = judge_edge(codecs, extras)
    cloud = judge_cloud(codecs, extras, back_ends, providers)
    return MachineReport(
        versions=find_versions(),
        codecs=codecs,
        back_ends=back_ends,
        inference_providers=providers,
        extras=extras,
        hardware=find_hardware(),
        verdicts=(edge, cloud, judge_study(edge, cloud, extras)),
    )


def find_versions() -> dict[str, str | None]:
    """Versions by package or library, None where it isn't installed; read from metadata, so nothing is imported."""
    versions: dict[str, str | None] = {PACKAGE: cable_rpc.__version__, "python": platform.python_version()}
    versions |= {package: installed_version(package) for package in VERSIONED}
    versions["FFmpeg"] = str(av.ffmpeg_version_info)
    versions |= {library: ".".join(map(str, av.library_versions[library])) for library in LIBRARIES}
    return versions


def installed_version(package: str) -> str | None:
    """Of the package or of another that brings the same module."""
    for name in (package, *STAND_INS.get(package, ())):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return None


def find_back_ends() -> tuple[BackEnd, ...]:
    """Detectors and segmenters that ``cable-rpc serve`` knows by name, this package's and others'."""
    found = {
        BackEnd(kind, entry.name, entry.module, entry.dist.name if entry.dist else "?")
        for kind in BACK_END_KINDS
        for entry in entry_points(group=f"{PACKAGE.replace('-', '_')}.{kind}s")
    }
    return tuple(sorted(found, key=lambda back_end: (back_end.kind, back_end.name, back_end.package)))


def inference_providers() -> tuple[str, ...]:
    """ONNX Runtime's execution providers, e.g. ``CUDAExecutionProvider``; empty where it can't be imported."""
    try:
        import onnxruntime
    except (ImportError, OSError):
        return ()
    return tuple(onnxruntime.get_available_providers())


def find_extras() -> tuple[Extra, ...]:
    """The base and each extra with its packages; empty where the package runs without being installed."""
    try:
        installed = distribution(PACKAGE)
    except PackageNotFoundError:
        return ()
    names = [name for name in installed.metadata.get_all("Provides-Extra") or [] if name != "all"]
    lines = installed.requires or []
    return tuple(Extra(name, requirements_of(lines, name)) for name in ("base", *names))


def requirements_of(lines: Iterable[str], extra: str) -> tuple[Requirement, ...]:
    """Requirements of one extra (``base``: of none) from the lines of ``Requires-Dist``."""
    requirements = []
    for line in lines:
        specification, _, marker = line.partition(";")
        wanted_by = re.search(r"""extra\s*==\s*["']([^"']+)["']""", marker)
        if (wanted_by.group(1) if wanted_by else "base") != extra:
            continue
        parsed = re.match(r"\s*([\w.-]+)\s*(?:\[[^\]]*\])?\s*(.*)", specification)
        if parsed is not None:
            package, wanted = parsed.group(1), parsed.group(2).strip(" ()")
            found = installed_version(package)
            requirements.append(Requirement(package, wanted, found, found is not None and recent_enough(found, wanted)))
    return tuple(requirements)


def recent_enough(found: str, wanted: str) -> bool:
    """Whether a version meets the lower bound of a specifier; other bounds are pip's to judge."""
    bound = re.search(r">=\s*([\d.]+)", wanted)
    return bound is None or release(found) >= release(bound.group(1))


def release(text: str) -> tuple[int, ...]:
    """``1.20.3rc1+cpu`` as (1, 20, 3), trailing zeros dropped."""
    numbers = re.match(r"\d+(?:\.\d+)*", text)
    parts = [int(part) for part in numbers.group().split(".")] if numbers else []
    while parts and parts[-1] == 0:
        parts.pop()
    return tuple(parts)


def find_hardware() -> Hardware:
    """Processors, memory, and whether an NVIDIA driver is loaded."""
    count = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else count
    memory = parse_memory(MEMORY_FILE.read_text()) if MEMORY_FILE.exists() else {}
    return Hardware(
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        cpu_count=count,
        usable_cpus=usable,
        opencv_threads=cv2.getNumThreads(),
        memory_bytes=memory.get("MemTotal"),
        available_memory_bytes=memory.get("MemAvailable"),
        nvidia_driver=NVIDIA_DRIVER.exists(),
    )


def parse_memory(text: str) -> dict[str, int]:
    """Bytes by name, from the text of ``/proc/meminfo`` (proc(5): "kB" there are 1024 bytes)."""
    return {name: int(size) * 1024 for name, size in re.findall(r"^(\w+):\s+(\d+) kB$", text, re.MULTILINE)}


def judge_edge(codecs: Sequence[CodecProbe], extras: Sequence[Extra]) -> Verdict:
    """Can this machine send what a camera sees?"""
    old = missing_of(extras, "base")
    if old:
        return Verdict("edge", "missing", f"absent or too old: {names_of(old)}", (f"pip install -U {PACKAGE}",))
    encoders = {probe.codec: probe.encoder for probe in reversed(codecs) if probe.usable}
    if not encoders:
        return Verdict("edge", "missing", "no encoder opens", ("pip install --force-reinstall av",))
    if DEFAULT_CODEC not in encoders:
        others = ", ".join(sorted(encoders))
        return Verdict(
            "edge",
            "partly",
            f"no encoder of {DEFAULT_CODEC}, the default codec; {others} work",
            (f"cable-rpc stream --codec {first_of(encoders, codecs)}", "pip install --force-reinstall av"),
        )
    hardware = [probe.encoder for probe in codecs if probe.usable and probe.hardware]
    aside = f"; in hardware: {', '.join(hardware)}" if hardware else "; no hardware encoder"
    return Verdict("edge", "ready", f"{DEFAULT_CODEC} by {encoders[DEFAULT_CODEC]}{aside}")


def judge_cloud(
    codecs: Sequence[CodecProbe], extras: Sequence[Extra], back_ends: Sequence[BackEnd], providers: Sequence[str]
) -> Verdict:
    """Can this machine receive pictures and answer them?"""
    if not extras:
        return Verdict("cloud", "missing", f"{PACKAGE} runs uninstalled: no back end is known", ("pip install -e .",))
    command = "pip install 'cable-rpc[cloud]'"
    if not providers:
        return Verdict("cloud", "missing", "ONNX Runtime is absent or does not load", (command,))
    absent = [kind for kind in BACK_END_KINDS if not any(back_end.kind == kind for back_end in back_ends)]
    if absent:
        return Verdict("cloud", "missing", f"no {' and no '.join(absent)} back end is registered", (command,))
    undecoded = sorted({probe.codec for probe in codecs if probe.decoder is None})
    if DEFAULT_CODEC in undecoded:
        return Verdict("cloud", "missing", f"{DEFAULT_CODEC} can't be decoded", ("pip install --force-reinstall av",))
    where = "NVIDIA GPU" if "CUDAExecutionProvider" in providers and NVIDIA_DRIVER.exists() else "CPU"
    gaps = [f"{', '.join(undecoded)} can't be decoded"] if undecoded else []
    unmet = [requirement.package for requirement in missing_of(extras, "cloud")]
    without = [package for package in LANGUAGE_MODEL_PACKAGES if package in unmet]
    if without:
        gaps.append(f"no language-model segmenter ({', '.join(without)} absent or too old)")
    if gaps:
        return Verdict("cloud", "partly", f"serves on {where}; {'; '.join(gaps)}", (command,))
    return Verdict("cloud", "ready", f"serves on {where}")


def judge_study(edge: Verdict, cloud: Verdict, extras: Sequence[Extra]) -> Verdict:
    """Can this machine run the loop, score it and draw the report?"""
    missing = missing_of(extras, "study")
    command = "pip install 'cable-rpc[cloud,study]'"
    if missing or not extras:
        reason = f"absent or too old: {names_of(missing)}" if missing else f"{PACKAGE} runs uninstalled"
        return Verdict("study", "missing", reason, (command if extras else "pip install -e '.[cloud,study]'",))
    unready = [verdict.role for verdict in (edge, cloud) if verdict.state == "missing"]
    if unready:
        return Verdict(
            "study",
            "partly",
            f"reports can be drawn, but not the loop run: {' and '.join(unready)} missing",
            (command,),
        )
    return Verdict("study", "ready", "runs the loop on this machine, scores it and draws the report")


def missing_of(extras: Sequence[Extra], name: str) -> tuple[Requirement, ...]:
    """What an extra lacks."""
    return next((extra.missing for extra in extras if extra.name == name), ())


def names_of(requirements: Iterable[Requirement]) -> str:
    """Packages with their bounds."""
    return ", ".join(f"{requirement.package}{requirement.wanted}" for requirement in requirements)


def first_of(encoders: dict[str, str], codecs: Sequence[CodecProbe]) -> str:
    """The usable codec that is listed last: video codecs come after still ones."""
    return [probe.codec for probe in codecs if probe.codec in encoders][-1]
