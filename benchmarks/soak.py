"""A server under clients that come, go and die: ``python benchmarks/soak.py --minutes 30 --streams 8``.

The server is `cable-rpc serve` with the embedded detector. Each stream is a process that sends coded video of a
rendered drive, in sessions of random lengths, codecs and regions; at random, seeded moments one of them is killed with
SIGKILL or told to end, and another one takes its place. Resident memory of the server is sampled every second; its
slope after the warm-up is fitted by least squares to means of ten seconds, with the standard error of that fit. The
ledgers of all clients must add up: every frame of a session that ended in good order answered once, of others no more
unanswered than the credit, and no session broken but by SIGKILL.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from soak_runs import Life, live, read_books, render_drive

SPAWN = get_context("spawn")
MEAN_LIFE_S = 25.0
KILLED_SHARE = 0.5
BLOCK_S = 10
CREDIT = 2
EXPECTED_EXITS = ("exit 0", f"exit {-signal.SIGKILL}", f"exit {-signal.SIGTERM}")
"""SIGTERM: told to end before it was there."""


@contextmanager
def serving(arguments: list[str]) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`cable-rpc serve`; its process and HOST:PORT. Ends it with SIGTERM, which it must obey."""
    command = [sys.executable, "-m", "cable_rpc", "serve", "--listen", "127.0.0.1:0", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            found = re.search(r"listening on (\S+:\d+)", line)
            if found:
                break
        else:
            raise SystemExit("the server did not start")
        yield process, found[1]
        process.send_signal(signal.SIGTERM)
        process.wait(20)
    finally:
        process.kill()
        process.wait()


class Crowd:
    """Keeps a number of clients alive, and ends one now and then."""

    def __init__(self, target: str, streams: int, frames_per_s: float, seed: int, folder: Path) -> None:
        self.source = random.Random(seed)
        self.target, self.frames_per_s, self.folder = target, frames_per_s, folder
        self.drive = folder / "drive.npy"
        render_drive(self.drive)
        self.events: Counter[str] = Counter()
        self.lives = 0
        self.clients: list[tuple[BaseProcess, float]] = [self.born() for _ in range(streams)]

    def born(self) -> tuple[BaseProcess, float]:
        """A new client, and when it is to end."""
        life = Life(
            self.target,
            self.lives,
            self.source.randrange(1 << 32),
            self.frames_per_s,
            self.drive,
            self.folder / f"{self.lives}.ledger",
        )
        self.lives += 1
        self.events["born"] += 1
        process = SPAWN.Process(target=live, args=(life,), daemon=True)
        process.start()
        return process, time.monotonic() + self.source.expovariate(1.0 / MEAN_LIFE_S)

    def churn(self) -> None:
        """Ends those whose time has come and replaces all that have ended."""
        for place, (process, ends_s) in enumerate(self.clients):
            if not process.is_alive():
                self.events[f"exit {process.exitcode}"] += 1
                self.clients[place] = self.born()
            elif time.monotonic() >= ends_s:
                kill = self.source.random() < KILLED_SHARE
                os.kill(process.pid or 0, signal.SIGKILL if kill else signal.SIGTERM)
                self.events["killed" if kill else "told to end"] += 1
                self.clients[place] = (process, ends_s + 60.0)

    def dismiss(self) -> None:
        """Tells all to end, and waits."""
        for process, _ in self.clients:
            process.terminate()
        for process, _ in self.clients:
            process.join(30)

    @property
    def ledgers(self) -> list[Path]:
        return sorted(self.folder.glob("*.ledger"))


def resident_mb(pid: int) -> float:
    """Of a process that must be alive."""
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    if found is None:
        raise SystemExit(f"process {pid} has died")
    return int(found[1]) / 1024


def slope(memory_mb: list[float]) -> tuple[float, float]:
    """MB a minute of samples a second apart, and its standard error, by least squares on means of ten seconds."""
    means = np.array(memory_mb[: len(memory_mb) // BLOCK_S * BLOCK_S]).reshape(-1, BLOCK_S).mean(axis=1)
    minutes = (np.arange(len(means)) + 0.5) * BLOCK_S / 60.0
    centred = minutes - minutes.mean()
    rate = float(centred @ means / (centred @ centred))
    residual = means - means.mean() - rate * centred
    error = float(np.sqrt(residual @ residual / (len(means) - 2) / (centred @ centred)))
    return rate, error


def soak(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Runs it; the report."""
    memory_mb: list[float] = []
    with serving(options.serve) as (server, target):
        crowd = Crowd(target, options.streams, options.frames_per_s, options.seed, folder)
        started_s = time.monotonic()
        while (elapsed_s := time.monotonic() - started_s) < options.minutes * 60.0:
            crowd.churn()
            if elapsed_s >= len(memory_mb):
                memory_mb.append(resident_mb(server.pid))
                if len(memory_mb) % 60 == 0:
                    print(f"{len(memory_mb) // 60} min: {memory_mb[-1]:.1f} MB, {dict(crowd.events)}", flush=True)
            time.sleep(0.1)
        crowd.dismiss()
        idle_mb = resident_mb(server.pid)
    warm_up_s = round(options.warm_up * 60.0)
    rate, error = slope(memory_mb[warm_up_s:])
    return {
        "minutes": options.minutes,
        "streams": options.streams,
        "frames_per_s": options.frames_per_s,
        "serve": options.serve,
        "server_exit": server.returncode,
        "memory_mb": {
            "start": memory_mb[0],
            "after_warm_up": memory_mb[warm_up_s],
            "end": memory_mb[-1],
            "most": max(memory_mb),
            "idle": idle_mb,
        },
        "slope_mb_per_min": rate,
        "slope_standard_error": error,
        "events": dict(crowd.events),
        "frames": asdict(read_books(crowd.ledgers)),
        "load_average": os.getloadavg(),
    }


def faults(report: dict[str, Any]) -> list[str]:
    """What is not as it must be."""
    frames, found = report["frames"], []
    if report["slope_mb_per_min"] >= 1.0:
        found.append(f"memory grows by {report['slope_mb_per_min']:.2f} MB a minute")
    if frames["broken"]:
        found.append(f"{sum(frames['broken'].values())} sessions broke")
    if frames["unanswered"] or frames["twice"]:
        found.append(f"{frames['unanswered']} frames unanswered, {frames['twice']} answers too many")
    if frames["most_lost"] > CREDIT:
        found.append(f"{frames['most_lost']} frames unanswered at the end of a session, the credit is {CREDIT}")
    if report["server_exit"] != 0:
        found.append(f"the server ended with {report['server_exit']}")
    if odd := [event for event in report["events"] if event.startswith("exit") and event not in EXPECTED_EXITS]:
        found.append(f"clients ended with {', '.join(odd)}")
    if not frames["answered"]:
        found.append("no frame was answered")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--warm-up", type=float, default=None, help="minutes; a fifth of all by default")
    parser.add_argument("--streams", type=int, default=8)
    parser.add_argument("--frames-per-s", type=float, default=3.0, help="of each stream")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="write the report here, as JSON")
    parser.add_argument(
        "serve", nargs="*", default=["--segmenter", "boxes"], help="options of `cable-rpc serve`, after --"
    )
    options = parser.parse_args()
    if options.warm_up is None:
        options.warm_up = options.minutes / 5.0
    with tempfile.TemporaryDirectory() as folder:
        report = soak(options, Path(folder))
    report["faults"] = faults(report)
    text = json.dumps(report, indent=2)
    print(text)
    if options.out is not None:
        options.out.write_text(text)
    return int(bool(report["faults"]))


if __name__ == "__main__":
    sys.exit(main())
