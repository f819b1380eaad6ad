"""A server in a process of its own: it can be killed, and what it takes of memory is its own."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from .secure_server import serving

SPAWN = get_context("spawn")
PATIENCE_S = 15.0


@dataclass(frozen=True, slots=True)
class ServerProcess:
    """A running server."""

    target: str
    process: BaseProcess
    pipe: Connection

    def memory_mb(self) -> float:
        """Resident memory."""
        status = Path(f"/proc/{self.process.pid}/status")
        if not status.exists():
            pytest.skip("needs Linux's /proc")
        found = re.search(r"VmRSS:\s+(\d+) kB", status.read_text())
        assert found is not None, "the server has died"
        return int(found[1]) / 1024

    def streams_left(self) -> int:
        """Streams that are still counted when the server has had time to end them; it serves no more afterwards."""
        self.pipe.send("stop")
        assert self.pipe.poll(PATIENCE_S + 5.0), "the server's event loop does not answer"
        return int(self.pipe.recv())


@contextmanager
def server_process() -> Iterator[ServerProcess]:
    """A server of the tests' models, in plain text on loopback."""
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=_serve, args=(theirs,), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ServerProcess(f"127.0.0.1:{ours.recv()}", process, ours)
        assert process.is_alive() or process.exitcode == 0, f"the server ended with {process.exitcode}"
    finally:
        process.kill()
        process.join()


def _serve(pipe: Connection) -> None:
    asyncio.run(_serve_until_told(pipe))


async def _serve_until_told(pipe: Connection) -> None:
    async with serving() as server:
        pipe.send(server.port)
        await asyncio.to_thread(pipe.recv)
        try:
            await asyncio.wait_for(server._service._idle.wait(), PATIENCE_S)
        finally:
            pipe.send(server._service._admission.streams)
