"""Which ONNX Runtime execution provider runs a graph, asked for by name, checked, and told."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnxruntime as ort

from cable_models.errors import ModelError

log = logging.getLogger(__name__)

CPU = "CPUExecutionProvider"
PROVIDERS: Mapping[str, str] = {
    "cpu": CPU,
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
}
"""Short name to ONNX Runtime's."""

PACKAGES: Mapping[str, str] = {
    "CUDAExecutionProvider": "onnxruntime-gpu",
    "TensorrtExecutionProvider": "onnxruntime-gpu and NVIDIA's TensorRT libraries",
    "OpenVINOExecutionProvider": "onnxruntime-openvino",
}
"""What brings a provider that the installed ONNX Runtime lacks."""

FALLBACKS: Mapping[str, Sequence[str]] = {
    "TensorrtExecutionProvider": ("CUDAExecutionProvider", CPU),
    "CUDAExecutionProvider": (CPU,),
    "OpenVINOExecutionProvider": (CPU,),
    CPU: (),
}
"""Who takes the nodes that a provider has no kernel for."""

AUTO_ORDER = ("CUDAExecutionProvider", "OpenVINOExecutionProvider", CPU)
"""TensorRT is left out: it builds an engine for minutes at the first start, which a user should ask for."""


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """How a graph is run."""

    provider: str = "auto"
    """A key of ``PROVIDERS``, ONNX Runtime's own name, or ``auto``: the fastest that starts, aloud."""
    threads: int = 1
    """CPU threads inside one inference."""
    spin: bool = True
    """Idle threads spin for a while, which is faster on a machine of one's own and wasteful on a shared one."""
    io_binding: bool | None = None
    """Bind inputs and outputs instead of passing arrays; None = where the provider isn't the CPU."""
    device_id: int = 0
    """Number of the GPU."""
    engine_cache: Path | None = None
    """Folder in which TensorRT keeps its engines between starts."""
    fp16: bool = False
    """Let TensorRT compute in half precision where that is faster."""

    def __post_init__(self) -> None:
        """Refuses settings that can't work.

        Raises:
            ModelError: which one, and its range.
        """
        if self.threads < 1:
            raise ModelError(f"threads must be at least 1, got {self.threads}")
        if self.device_id < 0:
            raise ModelError(f"the GPU's number must be at least 0, got {self.device_id}")


@dataclass(frozen=True, slots=True)
class ProviderChoice:
    """What was asked of ONNX Runtime, and what really runs."""

    requested: str
    active: tuple[str, ...]
    """In order of preference; the last ones take what the first has no kernel for."""
    note: str = ""
    """Why ``active`` is not what one would expect; empty where it is."""

    @property
    def serving(self) -> str:
        """The provider that runs the graph."""
        return self.active[0]


def candidates(provider: str) -> tuple[str, ...]:
    """The providers to ask for, best first.

    Raises:
        ModelError: unknown, or not part of the installed ONNX Runtime; says what would bring it.
    """
    available = ort.get_available_providers()
    if provider == "auto":
        return tuple(name for name in AUTO_ORDER if name in available)
    name = PROVIDERS.get(provider.lower(), provider)
    if name not in PROVIDERS.values() and name not in available:
        raise ModelError(f"provider '{provider}' is unknown; use auto, {', '.join(PROVIDERS)}")
    if name not in available:
        raise ModelError(
            f"the installed ONNX Runtime {ort.__version__} has no {name}, only {', '.join(available)}; "
            f"put {PACKAGES.get(name, 'a build that has it')} in its place (uninstall onnxruntime first: both fill one "
            "folder), or choose another provider"
        )
    return (name, *(other for other in FALLBACKS.get(name, (CPU,)) if other in available))


def provider_options(name: str, settings: SessionSettings) -> dict[str, Any]:
    """A provider's own settings."""
    if name == "CUDAExecutionProvider":
        # the exhaustive default searches anew, for seconds, at every batch size that comes by
        return {"device_id": settings.device_id, "cudnn_conv_algo_search": "HEURISTIC"}
    if name == "TensorrtExecutionProvider":
        options: dict[str, Any] = {"device_id": settings.device_id, "trt_fp16_enable": settings.fp16}
        if settings.engine_cache is not None:
            settings.engine_cache.mkdir(parents=True, exist_ok=True)
            options |= {"trt_engine_cache_enable": True, "trt_engine_cache_path": str(settings.engine_cache)}
        return options
    if name == "OpenVINOExecutionProvider":
        return {"num_of_threads": str(settings.threads)}
    return {}


def open_session(path: Path, settings: SessionSettings) -> tuple[ort.InferenceSession, ProviderChoice]:
    """Loads a graph and sees that the provider that was asked for really runs it.

    Raises:
        ModelError: no such file, ONNX Runtime can't read it, or the named provider did not start (ONNX Runtime
            itself would go on with another one without a word).
    """
    if not path.is_file():
        raise ModelError(f"no detector file {path}; give the path of an ONNX export of RT-DETR")
    wanted = candidates(settings.provider)
    if wanted[0] in ("CUDAExecutionProvider", "TensorrtExecutionProvider") and hasattr(ort, "preload_dlls"):
        # finds the CUDA libraries that pip installed, which are on no library path
        ort.preload_dlls()
    try:
        session = ort.InferenceSession(
            str(path),
            session_options(settings),
            providers=[(name, provider_options(name, settings)) for name in wanted],
        )
    except Exception as error:  # ONNX Runtime's exceptions share no narrower base
        raise ModelError(f"{path} is not a usable ONNX model: {error}") from error
    return session, judge(settings.provider, wanted, session.get_providers(), path)


def session_options(settings: SessionSettings) -> ort.SessionOptions:
    """Threads and logging."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = settings.threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "1" if settings.spin else "0")
    return options


def judge(requested: str, wanted: Sequence[str], active: Sequence[str], path: Path) -> ProviderChoice:
    """Compares what was asked for with what runs.

    Raises:
        ModelError: a provider asked for by name does not run.
    """
    if active[0] == wanted[0]:
        return ProviderChoice(requested, tuple(active))
    said = (
        f"{wanted[0]} did not start for {path.name}, {active[0]} did: its libraries are missing or don't fit the "
        "driver (ONNX Runtime's own words stand above)"
    )
    if requested != "auto":
        raise ModelError(f"{said}; repair that, or ask for provider auto or cpu")
    log.warning("%s", said)
    return ProviderChoice(requested, tuple(active), said)
