"""The models of a table's cells, loaded once for each process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from cable_rpc.cloud.backends import BackendOptions, load_detector, load_segmenter
from cable_rpc.cloud.model_runner import ThreadModelRunner
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sequence_metrics import OPERATING_SCORE
from cable_rpc.study.tables.score_keeper import WEAKEST_SCORE, ScoreKeeper
from cable_rpc.study.tables.settings import RunSettings


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


@lru_cache(maxsize=1)
def load_models(settings: RunSettings) -> LoadedModels:
    """Load what the settings name.

    Raises:
        ConfigurationError: unknown back end, or its extra is not installed.
        ModelError: a model can't be loaded.
    """
    options = BackendOptions(settings.device, settings.threads, WEAKEST_SCORE)
    try:
        keeper = ScoreKeeper(load_detector(settings.detector, options), OPERATING_SCORE)
        segmenter = load_segmenter(settings.segmenter, options)
    except ModuleNotFoundError as error:
        raise ConfigurationError(f"{error.name} is missing: pip install 'cable-rpc[cloud,study]'") from error
    runners = ThreadModelRunner("detector"), ThreadModelRunner("segmenter")
    return LoadedModels(PerceptionModels(keeper, segmenter, *runners), keeper)
