"""Which models a server hosts and how they are shared out among streams; loads them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cable_rpc.cloud.backends import BackendOptions, Detector, Segmenter, load_detector, load_segmenter
from cable_rpc.cloud.batching import BatchPolicy
from cable_rpc.cloud.perception import PerceptionModels

GPU_BATCH, CPU_BATCH = 8, 2
"""Defaults: a GPU takes several frames in hardly more time than one; a CPU gains little and each frame waits longer."""

HAND_OVER_S = 0.2e-3
"""What a run in another thread costs at least, there and back; a model that is done sooner (an oracle, boxes on small
pictures) is not handed over."""


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """Both models, as `cable-rpc serve` and a cluster's configuration name them."""

    detector: str = "embedded"
    segmenter: str = "embedded"
    device: str = "auto"
    threads: int = 1
    """CPU threads of each model."""
    min_score: float = 0.4
    """Detections below are dropped."""
    detector_batch: int | None = None
    """Most frames in one run; None = what suits the device."""
    segmenter_batch: int | None = None
    detector_workers: int = 1
    """Runs of the detector at a time."""
    batch_wait_s: float = 0.0
    """How long a free model waits for a batch to fill."""
    latency_bound_s: float = 0.0
    """After which frames that no model could begin with are shed; batches take half of it at most. 0 = no bound."""

    @property
    def backend_options(self) -> BackendOptions:
        """What every back end is given."""
        return BackendOptions(device=self.device, threads=self.threads, min_score=self.min_score)

    def load_detector(self) -> Detector:
        """The detector.

        Raises:
            ConfigurationError: unknown, or unusable options.
            ModelError: it can't be loaded.
        """
        return load_detector(self.detector, self.backend_options)

    def load_segmenter(self) -> Segmenter:
        """The segmenter; raises as `load_detector`."""
        return load_segmenter(self.segmenter, self.backend_options)

    def detector_policy(self, device: str) -> BatchPolicy:
        """How the detector's frames are batched on that device."""
        return self._policy(self.detector_batch, device, self.detector_workers)

    def segmenter_policy(self, device: str) -> BatchPolicy:
        """How the segmenter's frames are batched on that device."""
        return self._policy(self.segmenter_batch, device)

    def load(self) -> PerceptionModels:
        """Both models in this process; raises as `load_detector`."""
        # The detector first: it is loaded in a moment, and what is wrong with it should not wait for a large segmenter.
        detector = self.load_detector()
        segmenter = self.load_segmenter()
        return PerceptionModels.in_process(
            detector, segmenter, self.detector_policy(detector.device), self.segmenter_policy(segmenter.device)
        )

    def _policy(self, size: int | None, device: str, workers: int = 1) -> BatchPolicy:
        usual = CPU_BATCH if "cpu" in device.lower() else GPU_BATCH
        return BatchPolicy(
            size or usual, self.batch_wait_s, workers, self.latency_bound_s / 2 or math.inf, at_once_s=HAND_OVER_S
        )
