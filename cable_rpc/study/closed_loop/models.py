"""The models of a measured loop, loaded once for each process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from cable_rpc.cloud.backends import BackendOptions, load_detector, load_segmenter
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.closed_loop.score_keeper import WEAKEST_SCORE, ScoreKeeper


@dataclass(frozen=True, slots=True)
class ModelChoice:
    """Which models answer the frames."""

    segmenter: str = "embedded"
    detector: str = "embedded"
    device: str = "auto"
    threads: int = 1
    """CPU threads of each model."""


@dataclass(frozen=True, slots=True)
class LoadedModels:
    """What answers the frames, and where the detector's weak finds are kept."""

    perception: PerceptionModels
    keeper: ScoreKeeper

    @property
    def names(self) -> tuple[str, str]:
        """Detector and segmenter with their revisions."""
        both = (self.keeper, self.perception.segmenter)
        detector, segmenter = (f"{model.name} ({model.revision}, {model.device})" for model in both)
        return detector, segmenter


ModelLoader = Callable[[ModelChoice], LoadedModels]


@lru_cache(maxsize=1)
def load_models(choice: ModelChoice) -> LoadedModels:
    """Load what is named.

    Raises:
        ConfigurationError: unknown back end, or its extra is not installed.
        ModelError: a model can't be loaded.
    """
    options = BackendOptions(choice.device, choice.threads, WEAKEST_SCORE)
    try:
        keeper = ScoreKeeper(load_detector(choice.detector, options))
        segmenter = load_segmenter(choice.segmenter, options)
    except ModuleNotFoundError as error:
        raise ConfigurationError(f"{error.name} is missing: pip install 'cable-rpc[cloud,study]'") from error
    return LoadedModels(PerceptionModels.in_process(keeper, segmenter, side_by_side=False), keeper)
