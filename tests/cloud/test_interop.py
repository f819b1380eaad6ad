"""The plain client and the plain bitmap decoder of docs/interop, which know nothing of CABLE-RPC but its documents."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import sys
import zlib
from importlib.resources import files
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from cable_codecs import decode_mask, encode_mask
from cable_codecs.mask_runs import changes_to_bytes, column_changes, row_changes
from google.rpc import status_pb2
from grpc_tools import protoc
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource

from .secure_server import serving

MOST_LINES = 60


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"interop_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def bitmap(repository: Path) -> ModuleType:
    return load(repository / "docs" / "interop" / "bitmap.py")


@pytest.fixture(scope="module")
def stubs(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made from the .proto as docs/interop.md says."""
    folder = tmp_path_factory.mktemp("stubs")
    include = [repository / "proto", Path(status_pb2.__file__).parents[2], files("grpc_tools") / "_proto"]
    outputs = [f"--python_out={folder}", f"--grpc_python_out={folder}"]
    assert protoc.main(["protoc", *(f"-I{path}" for path in include), *outputs, "cable/v1/perception.proto"]) == 0
    return folder


async def run_plain_client(repository: Path, stubs: Path, *arguments: str) -> tuple[str, str, int]:
    environment = os.environ | {"PYTHONPATH": str(stubs)}
    client = repository / "docs" / "interop" / "plain_client.py"
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        str(client),
        *arguments,
        env=environment,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    out, error = await asyncio.wait_for(process.communicate(), 60)
    assert process.returncode is not None
    return out.decode(), error.decode(), process.returncode


async def test_plain_client_gets_boxes_and_masks(repository: Path, stubs: Path, tmp_path: Path) -> None:
    """On frames of the rendered drive with one bright patch, which is what the server's detector finds."""
    pictures = []
    for frame in SyntheticSource(SyntheticConfig(width=192, height=128, frame_count=2, seed=3)):
        image = np.minimum(frame.image, 120)
        image[32:64, 80:144] = 255
        pictures.append(str(tmp_path / f"{frame.index}.png"))
        cv2.imwrite(pictures[-1], image)
    async with serving() as server:
        out, error, code = await run_plain_client(repository, stubs, f"127.0.0.1:{server.port}", *pictures)
        await asyncio.wait_for(server._service._idle.wait(), 5)
    assert code == 0, error
    first, *lines = out.splitlines()
    assert first.endswith(": bright, boxes")
    for picture, (box, mask) in zip(pictures, (lines[:2], lines[2:]), strict=True):
        assert box.startswith(f"{picture}: class 2, score 0.90, ")
        left, top, right, bottom = map(int, box.split(", ", 2)[2].replace(" to ", ",").split(","))
        assert (left, top, right, bottom) == pytest.approx((80, 32, 144, 64), abs=3)
        assert mask == f"{picture}: mask of {(right - left) * (bottom - top)} pixels"


async def test_plain_client_says_why_it_was_sent_away(repository: Path, stubs: Path, tmp_path: Path) -> None:
    picture = str(tmp_path / "large.png")
    cv2.imwrite(picture, np.zeros((128, 192, 3), np.uint8))
    limits = SessionLimits(max_pixels=96 * 64, close_timeout_s=1.0)
    async with serving(limits=limits) as server:
        _, error, code = await run_plain_client(repository, stubs, f"127.0.0.1:{server.port}", picture)
    assert code == 1
    assert "lower resolution" in error
    assert "CLOSE_ACTION_STOP" in error


def test_plain_client_is_short(repository: Path) -> None:
    text = (repository / "docs" / "interop" / "plain_client.py").read_text()
    assert len(text.splitlines()) <= MOST_LINES
    assert "cable_rpc" not in text
    assert "cable_codecs" not in text


masks = hnp.arrays(np.bool_, st.tuples(st.integers(1, 24), st.integers(1, 24)), fill=st.booleans())


@settings(max_examples=60)
@given(mask=masks)
def test_documented_bitmaps(bitmap: ModuleType, mask: np.ndarray) -> None:
    """Each form of docs/wire-protocol.md, decoded by that page alone, and by us."""
    rows, columns = mask.shape
    xored = np.concatenate([mask[:1], mask[1:] ^ mask[:-1]])
    forms = {
        2: np.packbits(mask).tobytes(),
        3: np.packbits(xored).tobytes(),
        4: changes_to_bytes(*row_changes(mask), rows),
        5: changes_to_bytes(*column_changes(mask), columns),
    }
    coded = [bytes([form]) + zlib.compress(data, wbits=-15) for form, data in forms.items()]
    for data in (encode_mask(mask), *coded):
        np.testing.assert_array_equal(decode_mask(data, rows, columns), mask)
        np.testing.assert_array_equal(bitmap.decode_bitmap(data, rows, columns), mask)


def test_documented_form_6(bitmap: ModuleType) -> None:
    """Outlines and long stretches, as pictures of objects have them."""
    drive = SyntheticSource(SyntheticConfig(width=192, height=108, frame_count=1, seed=5))
    mask = np.ascontiguousarray(drive.frame(0).truth.instance_mask > 0)
    data = encode_mask(mask)
    assert data[0] == 6
    np.testing.assert_array_equal(bitmap.decode_bitmap(data, *mask.shape), mask)
    with pytest.raises(ValueError, match="check byte"):
        bitmap.decode_bitmap(data[:-1] + bytes([data[-1] ^ 1]), *mask.shape)
