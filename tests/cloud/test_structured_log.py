"""What goes into the log, read back as a log collector reads it."""

from __future__ import annotations

import asyncio
import io
import json
import logging
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from google.rpc import code_pb2

from cable_rpc.cli.demo import START_TIMEOUT_S
from cable_rpc.structured_log import LogFormat, configure_logging
from cable_rpc.wire.v1 import perception_pb2 as pb

from .conftest import FailingSegmenter, ServerFactory
from .secure_server import client, one_frame, serving

HOSTILE = 'car"}\n{"level":"critical","message":"forged"}\r\u2028\x1b[2J\x00'


@pytest.fixture
def logged() -> Iterator[Callable[[LogFormat], io.StringIO]]:
    """Logs into a text in place of what pytest set up."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level

    def start(form: LogFormat) -> io.StringIO:
        text = io.StringIO()
        root.handlers.clear()
        configure_logging(form, logging.INFO, text)
        return text

    yield start
    root.handlers[:] = handlers
    root.setLevel(level)


def entries(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.split("\n") if line]


async def test_entries_of_two_streams_tell_whose_they_are(logged: Any, running_server: ServerFactory) -> None:
    text = logged(LogFormat.JSON)
    began = datetime.now(UTC)
    async with (
        running_server(segmenter=FailingSegmenter()) as target,
        client(target) as first,
        client(target) as second,
    ):
        first_id, second_id = first.session_id, second.session_id
        await asyncio.gather(one_frame(first, 1), one_frame(second, 3))
    found = entries(text.getvalue())
    failures = [entry for entry in found if entry["message"].endswith("a model failed")]
    assert {entry["stream"] for entry in failures} == {first_id, second_id}
    for entry in failures:
        assert entry["stream"] in entry["message"]
        assert entry["level"] == "error"
        assert entry["logger"] == "cable_rpc.cloud.session"
        assert entry["identity"] == "anybody"
        assert entry["exception"].startswith("Traceback")
        assert entry["exception"].endswith("RuntimeError: secret path /etc/weights is broken")
        assert entry["time"].endswith("Z")
        assert timedelta(0) <= datetime.fromisoformat(entry["time"]) - began < timedelta(minutes=1)


@pytest.mark.parametrize("form", list(LogFormat))
async def test_a_client_can_not_forge_entries(logged: Any, form: LogFormat, stub_for: Any) -> None:
    text = logged(form)
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call = stub.StreamPerception()
        config = pb.CodecConfig(codec=pb.CODEC_JPEG, width=32, height=32, frame_rate=10)
        hello = pb.Hello(protocol_revision=1, client_id=HOSTILE, codec_config=config)
        await call.write(pb.StreamPerceptionRequest(hello=hello))
        assert (await call.read()).HasField("welcome")
        # Breaking a rule makes an entry beside the one about Hello.
        await call.write(pb.StreamPerceptionRequest(hello=hello))
        assert (await call.read()).closing.status.code == code_pb2.FAILED_PRECONDITION
        call.cancel()
    said = text.getvalue()
    if form is LogFormat.JSON:
        found = entries(said)
        assert {entry["level"] for entry in found} == {"info"}
        assert {entry["client"] for entry in found if "stream" in entry} <= {"", HOSTILE}
        assert found[-1]["client"] == HOSTILE
        assert said.isascii()
    else:
        assert all(" INFO cable_rpc." in line for line in said.splitlines())
    assert len(said.splitlines()) == said.count("\n") == 2


def test_a_traceback_in_text_is_indented_and_printable(logged: Any) -> None:
    text = logged(LogFormat.TEXT)
    try:
        raise ValueError("a\x1b[31m\n2026-01-01 00:00:00,000 ERROR root: forged")
    except ValueError:
        logging.getLogger("test").exception("a frame failed")
    first, *rest = text.getvalue().splitlines()
    assert first.endswith(" ERROR test: a frame failed")
    assert rest
    assert all(line.startswith("    ") and line.isprintable() for line in rest)


def test_serve_writes_nothing_but_json() -> None:
    command = [
        sys.executable, "-m", "cable_rpc", "serve", "--listen", "127.0.0.1:0", "--segmenter", "boxes",
        "--log-format", "json",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    lines = []
    try:
        for line in process.stderr:
            lines.append(line)
            if "revision" in line:
                process.terminate()
        output, _ = process.communicate(timeout=START_TIMEOUT_S)
    finally:
        process.kill()
    assert process.returncode == 0
    assert output == ""
    messages = [entry["message"] for entry in entries("".join(lines))]
    assert messages[0].startswith("listening on 127.0.0.1:")
    assert messages[-1].startswith("stopping")
