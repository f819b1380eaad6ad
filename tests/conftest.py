from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Time is measured in benchmarks; on a busy machine a deadline fails tests that are right.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# Models, codecs and OpenCV each start a thread pool; two test cores are served best by one thread for each.
os.environ.setdefault("OMP_NUM_THREADS", "1")

REPOSITORY = Path(__file__).resolve().parent.parent
SHARED = REPOSITORY.parent / "shared"


@pytest.fixture(scope="session")
def repository() -> Path:
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_clip() -> Path:
    clip = SHARED / "data" / "highway-540p" / "solidWhiteRight.mp4"
    if not clip.exists():
        pytest.skip(f"needs the real clip {clip.name} in ../shared/data")
    return clip


@pytest.fixture(scope="session")
def shared_detector() -> Path:
    weights = SHARED / "weights" / "deimv2_hgnetv2_femto_coco" / "deimv2_hgnetv2_femto_coco.onnx"
    if not weights.exists():
        pytest.skip(f"needs the real detector {weights.name} in ../shared/weights")
    return weights
