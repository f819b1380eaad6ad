"""What batching gives: ``python benchmarks/batching.py --streams 8``.

Servers with the embedded detector, one after the other and in several rounds, each as its own process and loaded by
one process with all streams: every stream has two frames under way and sends the next as soon as one is answered.
Printed are the medians over the rounds: frames a second of all streams, the time of an answered frame from sending to
answer, frames shed, and the slowest stream's share of the fastest's.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, field

import numpy as np
from cable_codecs import CodecParameters, create_encoder
from rich.console import Console
from rich.table import Table

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.wire.v1 import perception_pb2 as pb

WIDTH, HEIGHT = 960, 540
WARM_UP_S = 3.0
SERVERS = {
    "one frame at a time": ["--detector-batch", "1"],
    "one frame at a time, 2 threads": ["--detector-batch", "1", "--threads", "2"],
    "batches of 4": ["--detector-batch", "4"],
    "batches of 4, 2 threads": ["--detector-batch", "4", "--threads", "2"],
    "batches of 4, 2 workers": ["--detector-batch", "4", "--detector-workers", "2"],
    "batches of 4, 2 workers, 250 ms": [
        *("--detector-batch", "4", "--detector-workers", "2", "--latency-bound", "0.25"),
    ],
}


@dataclass
class Load:
    """What the streams saw."""

    seconds: float
    answered: list[int] = field(default_factory=list)
    """Per stream."""
    shed: int = 0
    latencies_ms: list[float] = field(default_factory=list)
    batch_sizes: list[int] = field(default_factory=list)

    @property
    def frames_per_s(self) -> float:
        return sum(self.answered) / self.seconds

    @property
    def fairness(self) -> float:
        return min(self.answered) / max(self.answered)


async def stream(target: str, packets: list[bytes], load: Load, from_s: float, until_s: float) -> None:
    """One camera that never waits."""
    sent_s: dict[int, float] = {}
    answered = 0
    async with PerceptionClient(target, SessionRequest("jpeg", WIDTH, HEIGHT, 30.0)) as client:

        async def send() -> None:
            sequence = 0
            while time.monotonic() < until_s:
                await client.acquire_credit()
                sent_s[sequence] = time.monotonic()
                data = packets[sequence % len(packets)]
                await client.send(pb.VideoFrame(sequence=sequence, data=data, keyframe=True))
                sequence += 1
            await client.finish()

        sender = asyncio.create_task(send())
        async for answer in client.answers():
            client.release_credit()
            now_s, began_s = time.monotonic(), sent_s.pop(answer.sequence)
            if began_s < from_s or now_s > until_s:
                continue
            if answer.rejection is None:
                answered += 1
                load.latencies_ms.append(1e3 * (now_s - began_s))
            else:
                load.shed += 1
        await sender
    load.answered.append(answered)


async def loaded(target: str, streams: int, seconds: float) -> Load:
    """All streams against one server."""
    source = SyntheticSource(SyntheticConfig(seed=5, width=WIDTH, height=HEIGHT, frame_count=8))
    with create_encoder(CodecParameters("jpeg", WIDTH, HEIGHT)) as encoder:
        packets = [encoder.encode(frame.image).data for frame in source]
    load = Load(seconds)
    from_s = time.monotonic() + WARM_UP_S
    await asyncio.gather(*(stream(target, packets, load, from_s, from_s + seconds) for _ in range(streams)))
    return load


def measured(flags: list[str], streams: int, seconds: float) -> Load:
    """A server of its own, started, loaded and stopped."""
    command = [sys.executable, "-m", "cable_rpc", "serve", "--listen", "127.0.0.1:0", "--segmenter", "boxes", *flags]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        line = server.stdout.readline() if server.stdout else ""
        found = re.search(r"127\.0\.0\.1:\d+", line)
        if found is None:
            raise SystemExit(f"the server did not start: {line!r}")
        return asyncio.run(loaded(found.group(), streams, seconds))
    finally:
        server.terminate()
        server.wait(timeout=20)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streams", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    runs: dict[str, list[Load]] = {name: [] for name in SERVERS}
    for number in range(options.rounds):
        for name, flags in SERVERS.items():
            runs[name].append(measured(flags, options.streams, options.seconds))
            print(f"round {number + 1}, {name}: {runs[name][-1].frames_per_s:.1f} frames/s", file=sys.stderr)
    title = f"{options.streams} streams of {WIDTH}x{HEIGHT}, {os.cpu_count()} cores, load generator included"
    table = Table(title=title)
    for heading in ("server", "frames/s", "ratio", "p50 ms", "p95 ms", "shed", "slowest/fastest"):
        table.add_column(heading, justify="left" if heading == "server" else "right")
    rates = {name: statistics.median(load.frames_per_s for load in loads) for name, loads in runs.items()}
    base = next(iter(rates.values()))
    for name, loads in runs.items():
        p50, p95 = np.percentile([ms for load in loads for ms in load.latencies_ms], [50, 95])
        table.add_row(
            name,
            f"{rates[name]:.1f}",
            f"{rates[name] / base:.2f}",
            f"{p50:.0f}",
            f"{p95:.0f}",
            str(sum(load.shed for load in loads)),
            f"{statistics.median(load.fairness for load in loads):.2f}",
        )
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
