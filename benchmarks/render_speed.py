"""Frames per second of the rendered world on one core."""

from __future__ import annotations

import argparse
import time

import cv2

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--height", type=int, default=540)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print("seed  street      light      set-up s  first s  fps (wall)  fps (cpu)")
    for seed in options.seeds:
        begin = time.perf_counter()
        source = SyntheticSource(SyntheticConfig(seed=seed, width=options.width, height=options.height))
        ready = time.perf_counter()
        source.frame(0)
        wall, cpu = time.perf_counter(), time.process_time()
        first = wall - ready
        for index in range(1, options.frames + 1):
            source.frame(index)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        world = source.world
        print(
            f"{seed:4}  {world.street.name:10}  {world.light.name:9}  {ready - begin:8.2f}  {first:7.2f}"
            f"  {options.frames / wall:10.1f}  {options.frames / cpu:9.1f}"
        )


if __name__ == "__main__":
    main()
