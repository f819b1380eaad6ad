"""Runs an ONNX graph, with arrays or with bound inputs and outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cable_models.errors import ModelError
from cable_models.rtdetr.providers import CPU, SessionSettings, open_session


class GraphRunner:
    """One session and the way in and out of it. Serves one thread at a time."""

    def __init__(self, path: Path, settings: SessionSettings) -> None:
        """Loads the graph.

        Raises:
            ModelError: see `open_session`.
        """
        self.path = path
        self.session, self.choice = open_session(path, settings)
        bound = settings.io_binding
        self.bound = self.choice.serving != CPU if bound is None else bound
        self.binding = self.session.io_binding() if self.bound else None

    @property
    def metadata(self) -> dict[str, str]:
        """The file's metadata_props."""
        return dict(self.session.get_modelmeta().custom_metadata_map)

    def run(self, outputs: Sequence[str], feed: Mapping[str, npt.NDArray[Any]]) -> list[npt.NDArray[Any]]:
        """The named outputs of one inference.

        Raises:
            ModelError: the graph failed.
        """
        try:
            if self.binding is None:
                return list(self.session.run(list(outputs), dict(feed)))
            return self.run_bound(self.binding, outputs, feed)
        except Exception as error:  # ONNX Runtime's exceptions share no narrower base
            shapes = {name: array.shape for name, array in feed.items()}
            raise ModelError(f"{self.path} failed on {shapes}: {error}") from error

    def run_bound(
        self, binding: Any, outputs: Sequence[str], feed: Mapping[str, npt.NDArray[Any]]
    ) -> list[npt.NDArray[Any]]:
        """The same through an IO binding: one copy to the device for an input, one back for an output."""
        binding.clear_binding_inputs()
        binding.clear_binding_outputs()
        for name, array in feed.items():
            binding.bind_cpu_input(name, np.ascontiguousarray(array))
        for name in outputs:
            # shapes follow the batch, so ONNX Runtime allocates; results land in host memory
            binding.bind_output(name, "cpu")
        self.session.run_with_iobinding(binding)
        return [np.asarray(array) for array in binding.copy_outputs_to_cpu()]
