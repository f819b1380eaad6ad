"""Exports kept between starts, so that naming a checkpoint is all it takes to serve it."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from cable_models.detection import Image
from cable_models.errors import ModelError
from cable_models.rtdetr.file_plan import FilePlan
from cable_models.rtdetr.hub import locate

log = logging.getLogger(__name__)


def default_cache() -> Path:
    """Where exports are kept: ``$XDG_CACHE_HOME/cable-rpc/rtdetr``, else below ``~/.cache``."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "cable-rpc" / "rtdetr"


def cached_file(
    name: str,
    revision: str | None,
    plan: FilePlan,
    verify: Callable[[], Sequence[Image]],
    folder: Path | None = None,
    say: Callable[[str], None] = log.info,
) -> Path:
    """The file of a checkpoint, exported at the first call for each revision and plan.

    Without network, the newest export of that name and plan serves, and the log says so.

    Args:
        name: As in `load_checkpoint`.
        revision: Commit, tag or branch on the hub.
        plan: Which form; int8 needs calibration frames and is left to the export command.
        verify: Gives frames to verify a new export on.
        folder: The cache, `default_cache` otherwise.
        say: Told of each step.

    Raises:
        ModelError: see `load_checkpoint` and `make_file`.
    """
    folder = folder or default_cache()
    slug = re.sub(r"[^\w.-]+", "--", name.strip("/"))
    try:
        located = locate(name, revision)
    except ModelError as error:
        kept = sorted(folder.glob(f"{slug}@*-{plan.key}.onnx"), key=lambda path: path.stat().st_mtime)
        if revision is not None or not kept:
            raise
        log.warning("%s; serving the earlier export %s", error, kept[-1].name)
        return kept[-1]
    path = folder / f"{slug}@{located.revision[:12]}-{plan.key}.onnx"
    if not path.is_file():
        # torch is needed for this, and for this only
        from cable_models.rtdetr.checkpoints import load_checkpoint
        from cable_models.rtdetr.detector_file import make_file

        made = make_file(load_checkpoint(name, revision), path, plan, verify(), say=say)
        say(f"wrote {made.path}")
    return path
