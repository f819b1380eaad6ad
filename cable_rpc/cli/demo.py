"""`cable-rpc demo`: the whole loop on one machine, as two processes over loopback."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, Queue
from typing import Annotated

import typer

from cable_rpc.cli.stream import console, run_and_report
from cable_rpc.data.source import open_source
from cable_rpc.errors import RemoteError
from cable_rpc.study.stream_run import StreamRunConfig

START_TIMEOUT_S = 60.0


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/demo"),
    seed: Annotated[int, typer.Option(help="Seed of the rendered driving clip.")] = 8,
    frames: Annotated[int, typer.Option(help="Length of the clip.", min=1)] = 80,
    codec: Annotated[str, typer.Option(help="h264 | jpeg | webp.")] = "h264",
) -> None:
    """Stream a rendered driving clip edge -> codec -> gRPC -> models -> mask -> edge, and show what it cost."""
    console.print(
        f"[bold]CABLE-RPC demo[/bold]: a rendered drive (synthetic:{seed}, {frames} frames), a server and an edge "
        "client as two processes over loopback. The models are the compact RT-DETR and LISA that ship with the package."
    )
    with local_server(["--detector", "embedded", "--segmenter", "embedded"]) as target:
        console.print(f"server ready on {target}")
        config = StreamRunConfig(target=target, out=out, codec=codec, command_line="cable-rpc demo")
        run_and_report(open_source(f"synthetic:{seed}", max_frames=frames), config)


@contextmanager
def local_server(arguments: list[str]) -> Iterator[str]:
    """Runs `cable-rpc serve` as a child process on a free loopback port; yields HOST:PORT.

    Raises:
        RemoteError: if it did not come up; carries what it said.
    """
    command = [sys.executable, "-m", "cable_rpc", "serve", "--listen", "127.0.0.1:0", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    lines: Queue[str | None] = Queue()
    threading.Thread(target=_collect, args=(process, lines), daemon=True).start()
    try:
        yield _wait_until_listening(lines)
    finally:
        process.terminate()
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _collect(process: subprocess.Popen[str], lines: Queue[str | None]) -> None:
    if process.stdout is not None:
        for line in process.stdout:
            lines.put(line.rstrip())
    lines.put(None)


def _wait_until_listening(lines: Queue[str | None]) -> str:
    said: list[str] = []
    while True:
        try:
            line = lines.get(timeout=START_TIMEOUT_S)
        except Empty:
            raise RemoteError(f"the server was not ready within {START_TIMEOUT_S:g} s: {' / '.join(said)}") from None
        if line is None:
            raise RemoteError(f"the server did not start: {' / '.join(said) or 'it said nothing'}")
        if line.startswith("listening on "):
            return line.removeprefix("listening on ")
        said.append(line)
