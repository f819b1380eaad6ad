"""Checks the contract: its style, and that it breaks no client of the last release. ``python proto/check.py``.

The last release is proto/released. Who releases copies proto/cable there, in the commit of the release:
``rm -r proto/released/cable && cp -r proto/cable proto/released/``.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

from google.rpc import status_pb2
from grpc_tools import protoc

ROOT = Path(__file__).resolve().parent
RELEASED = ROOT / "released"
PROTO = "cable/v1/perception.proto"
BUF = Path(sys.executable).parent / "buf"
"""From the package buf-bin, which the extra ``dev`` brings."""


def build_image(source: Path, image: Path) -> None:
    """Compiles a tree of .proto files, with everything that they import, into a descriptor set.

    Raises:
        ValueError: protoc refuses it; it has said why on the standard error.
    """
    include = [source, Path(status_pb2.__file__).parents[2], files("grpc_tools") / "_proto"]
    options = ["--include_imports", "--include_source_info", f"--descriptor_set_out={image}"]
    if protoc.main(["protoc", *(f"-I{folder}" for folder in include), *options, PROTO]):
        raise ValueError(f"{source / PROTO} is no valid contract")


def buf(*arguments: str | Path) -> list[str]:
    """What buf complains of, a line each.

    Raises:
        RuntimeError: buf itself failed.
    """
    command = [BUF, *arguments, "--config", ROOT / "buf.yaml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 100):
        raise RuntimeError(f"buf failed: {done.stderr.strip()}")
    return done.stdout.splitlines()


def style_problems(source: Path = ROOT) -> list[str]:
    """What the rules STANDARD and COMMENTS find in a tree of .proto files."""
    with tempfile.TemporaryDirectory() as folder:
        image = Path(folder) / "now.binpb"
        build_image(source, image)
        return buf("lint", image)


def breaking_changes(source: Path = ROOT, released: Path = RELEASED) -> list[str]:
    """What a client of the release would trip over."""
    with tempfile.TemporaryDirectory() as folder:
        now, before = Path(folder) / "now.binpb", Path(folder) / "before.binpb"
        build_image(source, now)
        build_image(released, before)
        return buf("breaking", now, "--against", before)


def main() -> int:
    """Prints the problems; 1 where there are any."""
    problems = [*style_problems(), *breaking_changes()]
    print("\n".join(problems) or "the contract keeps its rules, and breaks nothing of the last release")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
