"""Feeds damaged packets to a decoder, in a process of its own: ``fuzz_worker.py CODEC SEED SERIES``.

CODEC is a registered name or ``mask``. Memory is limited beforehand, so that a bomb ends the process instead of the
machine. Prints one JSON object; every entry of ``defects`` is a failure with what made it.
"""

from __future__ import annotations

import json
import random
import resource
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder, decode_mask, encode_mask
from cable_codecs.mask_codec import deflate
from cable_codecs.mask_runs import write_numbers
from codec_images import moving_clip

MEMORY_HEADROOM = 768 << 20
SIZES = ((64, 64), (96, 80), (131, 75))
"""(width, height); the seed chooses."""
MOST_DEFECTS = 5


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def limit_memory() -> None:
    """Allow the address space that is in use and some more."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_HEADROOM, used + MEMORY_HEADROOM))


def truncate(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return data[: rng.randrange(len(data))]


def flip_bits(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 40))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def flip_head(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    """Headers are where sizes and counts are."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 2, 4))):
        changed[rng.randrange(min(len(changed), 64))] = rng.randrange(256)
    return bytes(changed)


def splice(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    return data[: rng.randrange(len(data))] + other[rng.randrange(len(other)) :]


def join(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    return data + rng.choice((data, rng.choice(others)))


def cut_out(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    start = rng.randrange(len(data))
    return data[:start] + data[start + rng.randrange(1, 1 + max(1, len(data) // 4)) :]


def overwrite(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    start, value = rng.randrange(len(data)), rng.choice((b"\x00", b"\xff"))
    length = min(rng.choice((2, 4, 30)), len(data) - start)
    return data[:start] + value * length + data[start + length :]


def noise(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return data[: rng.randrange(min(len(data), 40))] + rng.randbytes(rng.randrange(300))


MUTATIONS: tuple[Callable[[random.Random, bytes, Sequence[bytes]], bytes], ...] = (
    truncate,
    flip_bits,
    flip_head,
    splice,
    join,
    cut_out,
    overwrite,
    noise,
)


def mutate(rng: random.Random, data: bytes, others: Sequence[bytes]) -> tuple[str, bytes]:
    mutation = rng.choice(MUTATIONS)
    return mutation.__name__, mutation(rng, data, others) if data else rng.randbytes(4)


def damaged_series(rng: random.Random, packets: list[bytes]) -> list[tuple[str, bytes]]:
    """Some packets of a clip, most as they were, in a disturbed order, some damaged."""
    series = [("whole", packet) for packet in packets]
    for _ in range(rng.choice((0, 0, 1, 2))):
        first, second = rng.randrange(len(series)), rng.randrange(len(series))
        kind = rng.choice(("reordered", "duplicated", "lost"))
        if kind == "reordered":
            series[first], series[second] = (kind, series[second][1]), (kind, series[first][1])
        elif kind == "duplicated":
            series.insert(second, (kind, series[first][1]))
        elif len(series) > 2:
            del series[first]
    for _ in range(rng.choice((1, 1, 2, 5))):
        place = rng.randrange(len(series))
        series[place] = mutate(rng, series[place][1], packets)
    return series


def fuzz_codec(name: str, seed: int, series_count: int) -> dict[str, object]:
    width, height = SIZES[seed % len(SIZES)]
    parameters = CodecParameters(name, width, height, keyframe_interval=1000)
    with create_encoder(parameters) as encoder:
        clip = moving_clip(12, height, width)
        packets = [encoder.encode(image, keyframe=index in (0, 4, 8)).data for index, image in enumerate(clip)]
    damaged, recovery = packets[:8], packets[8:]
    with create_decoder(parameters) as fresh:
        expected = [fresh.decode(packet) for packet in recovery]
    rng = random.Random(seed)
    defects: list[str] = []
    counts = {"refused": 0, "decoded": 0}
    before = 0
    for number in range(series_count):
        with create_decoder(parameters) as decoder:
            for kind, data in damaged_series(rng, damaged):
                try:
                    picture = decoder.decode(data)
                    counts["decoded"] += 1
                    if picture.shape != (height, width, 3) or picture.dtype != np.uint8:
                        defects.append(f"series {number}, {kind}: {picture.dtype} {picture.shape} from {data.hex()}")
                except CodecError:
                    counts["refused"] += 1
                except Exception as error:
                    defects.append(f"series {number}, {kind}: {error!r} from {data.hex()}")
            for index, packet in enumerate(recovery):
                try:
                    same = np.array_equal(decoder.decode(packet), expected[index])
                    problem = None if same else "another picture"
                except Exception as error:
                    problem = repr(error)
                if problem:
                    defects.append(f"series {number}: packet {index} after the next keyframe: {problem}")
        if len(defects) >= MOST_DEFECTS:
            break
        if number == series_count // 4:
            before = resident_bytes()
    return {**counts, "growth": resident_bytes() - before, "defects": defects}


def hostile_masks(rng: random.Random, rows: int, columns: int) -> bytes:
    """Well-packed nonsense: large counts and long zero runs behind a valid deflate stream."""
    kind = rng.randrange(4)
    if kind == 0:
        return bytes([rng.randrange(2, 6)]) + deflate(bytes(rng.choice((10, 1000, 30_000_000))))
    if kind == 1:
        numbers = [rows, *[1] * rows, *[columns] * rows, *[2] * (rows * min(columns, 300))]
        return bytes([rng.choice((4, 5))]) + deflate(write_numbers(np.array(numbers)))
    if kind == 2:
        numbers = [1, rows, rng.choice((1, columns, 2**20)), *(rng.randrange(2**21) for _ in range(rng.randrange(50)))]
        return bytes([rng.choice((4, 5))]) + deflate(write_numbers(np.array(numbers)))
    return bytes([6]) + rng.randbytes(rng.choice((0, 3, 100, 100_000)))


def fuzz_masks(seed: int, series_count: int) -> dict[str, object]:
    rng = random.Random(seed)
    smooth = cv2.GaussianBlur(np.random.default_rng(seed).random((540, 960)).astype(np.float32), (0, 0), 9) > 0.5
    noise_mask = np.random.default_rng(seed).random((68, 120)) > 0.5
    boxes = np.zeros((900, 1600), np.bool_)
    boxes[300:500, 200:700] = boxes[350:420, 900:1500] = True
    masks = [smooth, smooth[::8, ::8], noise_mask, boxes, boxes[::16, ::16], ~boxes[::8, ::8]]
    coded = [encode_mask(mask) for mask in masks] + [encode_mask(smooth, 0), encode_mask(boxes, 0)]
    shapes = [mask.shape for mask in masks] + [smooth.shape, boxes.shape]
    defects: list[str] = []
    counts = {"refused": 0, "decoded": 0, "tags": sorted({data[0] for data in coded})}
    before = 0
    for number in range(series_count):
        which = rng.randrange(len(coded))
        rows, columns = rng.choice((shapes[which], shapes[which], (2160, 3840)))
        kind, data = mutate(rng, coded[which], coded)
        if rng.random() < 0.1:
            kind, data = "hostile", hostile_masks(rng, rows, columns)
        try:
            mask = decode_mask(data, rows, columns)
            counts["decoded"] += 1
            if mask.shape != (rows, columns) or mask.dtype != np.bool_:
                defects.append(f"{kind}: {mask.dtype} {mask.shape} for {rows} x {columns} from {data[:300].hex()}")
        except CodecError:
            counts["refused"] += 1
        except Exception as error:
            defects.append(f"{kind}: {error!r} for {rows} x {columns} from {data[:300].hex()}")
        if len(defects) >= MOST_DEFECTS:
            break
        if number == series_count // 4:
            before = resident_bytes()
    if any(not np.array_equal(decode_mask(data, *mask.shape), mask) for data, mask in zip(coded, masks, strict=False)):
        defects.append("a whole mask comes back otherwise")
    return {**counts, "growth": resident_bytes() - before, "defects": defects}


def main() -> None:
    name, seed, series_count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    cv2.setNumThreads(1)
    limit_memory()
    report = fuzz_masks(seed, series_count) if name == "mask" else fuzz_codec(name, seed, series_count)
    print(json.dumps(report))


if __name__ == "__main__":
    main()
