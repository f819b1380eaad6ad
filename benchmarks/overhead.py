"""What the service adds to bare gRPC: ``python benchmarks/overhead.py``.

Frames of 60 KB go up one stream, one at a time, and up 8 streams likewise. The models cost nothing, and the JPEG is a
small picture padded with an application segment, so that decoding costs little. Four lines in one run, in turns:

* ``echo``: gRPC alone. Messages of the same bytes, answered with as many bytes as a Result has; no protobuf.
* ``stub``: our server, and a client that is the generated stub.
* ``client``: our server and our client, as the edge uses them.
* ``threads``: the same, with the models in threads of their own, as models are that take longer than 0.2 ms.

Server and load generator are a process each, on one machine; the figures are those of both ends together. Ratios are to
``echo``. With ``--profile FILE`` the event loop of our server is profiled (which slows it), and the functions that took
longest are written to FILE.
"""

from __future__ import annotations

import argparse
import os
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from overhead_runs import Load, LoadResult, answer_size, generate, serve_echo, serve_null_models
from rich.console import Console
from rich.table import Table

SPAWN = get_context("spawn")
CLIENTS = {"echo": "echo", "stub": "stub", "client": "client", "threads": "client"}
"""Line to kind of generator."""


@contextmanager
def running(server: Any, *settings: Any) -> Iterator[int]:
    """A server in its own process; its port."""
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=server, args=(theirs, *settings), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ours.recv()
        ours.send("stop")
        process.join(10)
    finally:
        process.kill()


def loaded(load: Load) -> LoadResult:
    """Runs one generator in its own process."""
    ours, theirs = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(target=generate, args=(load, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        return ours.recv()
    finally:
        process.join(10)
        process.kill()


def measure(options: argparse.Namespace, console: Console) -> dict[str, list[tuple[LoadResult, LoadResult]]]:
    """(one stream, many streams) of each line, once a round."""
    results = defaultdict(list)
    with (
        running(serve_null_models, True, options.profile) as port,
        running(serve_null_models, False, None) as threads_port,
    ):
        answer_bytes = answer_size(port, options.frame_bytes)
        with running(serve_echo, answer_bytes) as echo_port:
            console.print(f"up {options.frame_bytes} bytes, down {answer_bytes}; load average {os.getloadavg()[0]:.2f}")
            ports = {"echo": echo_port, "stub": port, "client": port, "threads": threads_port}
            for _ in range(options.rounds):
                for line, client in CLIENTS.items():
                    target = f"127.0.0.1:{ports[line]}"
                    one, many = (
                        loaded(Load(client, target, streams, options.seconds, options.frame_bytes))
                        for streams in (1, options.streams)
                    )
                    results[line].append((one, many))
    return results


def table(results: dict[str, list[tuple[LoadResult, LoadResult]]], streams: int) -> Table:
    """Medians over the rounds, and their spread."""
    shown = Table(title="both ends together; median of the rounds (lowest to highest)", title_justify="left")
    heads = ("p50, one stream", "p95", "ratio", f"frames/s, {streams} streams", "ratio", "p50 of those", "p95")
    for head in ("", *heads):
        shown.add_column(head, justify="left" if head == "" else "right")

    def over_rounds(line: str, figure: Any) -> np.ndarray:
        return np.array([figure(*pair) for pair in results[line]])

    figures = {
        "p50": lambda one, many: np.percentile(one.latencies_ms, 50),
        "p95": lambda one, many: np.percentile(one.latencies_ms, 95),
        "rate": lambda one, many: many.frames_per_s,
        "p50 many": lambda one, many: np.percentile(many.latencies_ms, 50),
        "p95 many": lambda one, many: np.percentile(many.latencies_ms, 95),
    }
    for line in CLIENTS:
        values = {name: over_rounds(line, figure) for name, figure in figures.items()}
        slower = values["p50"] / over_rounds("echo", figures["p50"])
        fewer = over_rounds("echo", figures["rate"]) / values["rate"]
        rate = values["rate"]
        shown.add_row(
            line,
            f"{np.median(values['p50']):.2f} ms ({values['p50'].min():.2f} to {values['p50'].max():.2f})",
            f"{np.median(values['p95']):.2f} ms",
            f"{np.median(slower):.2f}",
            f"{np.median(rate):.0f} ({rate.min():.0f} to {rate.max():.0f})",
            f"{np.median(fewer):.2f}",
            f"{np.median(values['p50 many']):.2f} ms",
            f"{np.median(values['p95 many']):.2f} ms",
        )
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each measurement")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--streams", type=int, default=8)
    parser.add_argument("--frame-bytes", type=int, default=60_000)
    parser.add_argument("--profile", type=Path, help="write the server's hot functions here")
    options = parser.parse_args()
    console = Console(width=140)
    console.print(table(measure(options, console), options.streams))
    if options.profile is not None:
        console.print(f"profile: {options.profile}")


if __name__ == "__main__":
    main()
