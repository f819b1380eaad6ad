"""One life of a client of `soak.py`: it streams coded video until it is killed or told to end, and keeps a ledger.

The ledger is a file that each event is appended to in one write, so that it tells the truth of a killed process too:
``o`` a session is open, ``s N`` frame N was handed to the transport, ``a N`` it was answered, ``r N REASON`` it was
rejected, ``g`` the session ended in good order, ``x WHY`` it broke.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from cable_codecs import STILL_CODECS, CodecParameters, RegionTreatment, TreatedEncoder, available_codecs

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.errors import CableError
from cable_rpc.types import RoiMask
from cable_rpc.wire.convert import region_to_message
from cable_rpc.wire.v1 import perception_pb2 as pb

WIDTH, HEIGHT = 320, 192
FRAMES = 40
BLOCK = 8
CODECS = ("h264", "jpeg", "h264", "webp", "vp9")
PATIENCE_S = 30.0
SHORTEST_SESSION, LONGEST_SESSION = 5, 60
"""Frames of a session before the client reconnects by itself."""


Note = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Life:
    """What one client process does."""

    target: str
    number: int
    seed: int
    frames_per_s: float
    drive: Path
    ledger: Path


def render_drive(path: Path) -> None:
    """A rendered drive, uint8 [FRAMES, HEIGHT, WIDTH, 3], for all clients to map into memory."""
    source = SyntheticSource(SyntheticConfig(width=WIDTH, height=HEIGHT, frame_count=FRAMES, seed=9))
    np.save(path, np.stack([frame.image for frame in source]))


def live(life: Life) -> None:
    """Streams, session after session, until SIGTERM."""
    asyncio.run(_live(life))


async def _live(life: Life) -> None:
    told = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, told.set)
    source = random.Random(life.seed)
    drive = np.load(life.drive, mmap_mode="r")
    ledger = os.open(life.ledger, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def note(event: str) -> None:
        os.write(ledger, f"{event}\n".encode())

    codecs = [codec for codec in CODECS if codec in available_codecs()]
    while not told.is_set():
        try:
            await _stream(life, source.choice(codecs), source, drive, told, note)
        except (CableError, TimeoutError) as error:
            note(f"x {type(error).__name__} {error}")
            return


async def _stream(
    life: Life, codec: str, source: random.Random, drive: np.ndarray, told: asyncio.Event, note: Note
) -> None:
    """One session of a random length, ended with Goodbye."""
    treatment = RegionTreatment.default_for(stateless=codec in STILL_CODECS)
    request = SessionRequest(
        codec, WIDTH, HEIGHT, life.frames_per_s, client_id=f"soak/{life.number}", treatment=treatment
    )
    parameters = CodecParameters(codec, WIDTH, HEIGHT, life.frames_per_s, threads=1)
    async with PerceptionClient(life.target, request) as session:
        note("o")
        answers = asyncio.create_task(_take_answers(session, note))
        with TreatedEncoder(parameters, treatment) as encoder:
            reference: int | None = None
            for sequence in range(source.randint(SHORTEST_SESSION, LONGEST_SESSION)):
                if told.is_set() or answers.done():
                    break
                wanted, session.keyframe_requested = session.keyframe_requested, False
                keyframe = reference is None or wanted
                image = np.ascontiguousarray(drive[(life.number * 7 + sequence) % FRAMES])
                blocks = None if keyframe else _region(source)
                packet = encoder.encode(image, blocks, BLOCK, keyframe=keyframe)
                message = pb.VideoFrame(sequence=sequence, data=packet.encoded.data, keyframe=packet.encoded.keyframe)
                if not packet.encoded.keyframe and reference is not None:
                    message.reference_sequence = reference
                if packet.blocks is not None:
                    roi = RoiMask(packet.blocks, packet.block_size, HEIGHT, WIDTH)
                    message.region.CopyFrom(region_to_message(roi))
                await asyncio.wait_for(session.acquire_credit(), PATIENCE_S)
                note(f"s {sequence}")
                await session.send(message)
                reference = sequence
                await asyncio.sleep(source.uniform(0.5, 1.5) / life.frames_per_s)
        await session.finish()
        await asyncio.wait_for(answers, PATIENCE_S)
        note("g")


async def _take_answers(session: PerceptionClient, note: Note) -> None:
    async for answer in session.answers():
        reason = (answer.rejection or "").partition(":")[0]
        note(f"r {answer.sequence} {reason}" if reason else f"a {answer.sequence}")
        session.release_credit()


def _region(source: random.Random) -> np.ndarray:
    blocks = np.zeros((HEIGHT // BLOCK, WIDTH // BLOCK), np.bool_)
    top, left = source.randrange(HEIGHT // BLOCK - 6), source.randrange(WIDTH // BLOCK - 10)
    blocks[top : top + 6, left : left + 10] = True
    return blocks


@dataclass
class Books:
    """All ledgers together."""

    sessions: int = 0
    goodbyes: int = 0
    sent: int = 0
    answered: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    lost_in_killed: int = 0
    """In flight when the client was killed, or its session broke."""
    most_lost: int = 0
    """Of those, in one session."""
    broken: dict[str, int] = field(default_factory=dict)
    """Sessions that broke under a client that was not killed, by reason: must be empty."""
    unanswered: int = 0
    """Of sessions that ended in good order: must be 0."""
    twice: int = 0
    """Answers to frames that had one, or were never sent: must be 0."""


def _count(counts: dict[str, int], what: str) -> None:
    counts[what] = counts.get(what, 0) + 1


def read_books(ledgers: list[Path]) -> Books:
    """Adds the ledgers up."""
    books = Books()
    for ledger in ledgers:
        for session in _sessions(ledger.read_text().splitlines()):
            _enter(books, session)
    return books


def _sessions(lines: list[str]) -> Iterator[list[str]]:
    session: list[str] = []
    for line in lines:
        if line == "o" and session:
            yield session
            session = []
        session.append(line)
    if session:
        yield session


def _enter(books: Books, session: list[str]) -> None:
    open_frames: set[str] = set()
    books.sessions += session[0] == "o"
    for line in session:
        kind, *rest = line.split()
        if kind == "s":
            open_frames.add(rest[0])
            books.sent += 1
        elif kind == "x":
            _count(books.broken, line.removeprefix("x "))
        elif kind in "ar":
            books.twice += rest[0] not in open_frames
            open_frames.discard(rest[0])
            books.answered += kind == "a"
            if kind == "r":
                _count(books.rejected, rest[1])
    if session[-1] == "g":
        books.goodbyes += 1
        books.unanswered += len(open_frames)
    else:
        books.lost_in_killed += len(open_frames)
        books.most_lost = max(books.most_lost, len(open_frames))
