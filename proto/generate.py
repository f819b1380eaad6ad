"""Regenerates the committed stubs in cable_rpc/wire/v1 from proto/cable/v1; run by `make proto`.

Uses an old, pinned generator on purpose: code made by it runs on every newer protobuf and grpc runtime, code made
by a new one refuses older runtimes.
"""

from __future__ import annotations

import sys
from importlib.resources import files
from pathlib import Path

from grpc_tools import protoc

ROOT = Path(__file__).resolve().parent.parent
PROTO = "cable_rpc/wire/v1/perception.proto"


def main() -> int:
    """Runs protoc; the path mapping puts the modules below cable_rpc while the wire name stays cable.v1."""
    return int(
        protoc.main(
            [
                "protoc",
                f"-Icable_rpc/wire/v1={ROOT / 'proto' / 'cable' / 'v1'}",
                f"-I{files('grpc_tools') / '_proto'}",
                f"-I{Path(sys.prefix) / 'lib' / f'python3.{sys.version_info.minor}' / 'site-packages'}",
                f"--python_out={ROOT}",
                f"--pyi_out={ROOT}",
                f"--grpc_python_out={ROOT}",
                PROTO,
            ]
        )
    )


if __name__ == "__main__":
    sys.exit(main())
