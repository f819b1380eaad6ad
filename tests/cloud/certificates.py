"""Certificates made by the openssl command: an independent maker of what our code reads."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Pair:
    certificate: Path
    key: Path


class Authority:
    """A certificate authority in a folder."""

    def __init__(self, folder: Path, name: str = "ca") -> None:
        if shutil.which("openssl") is None:
            pytest.skip("needs the openssl command to make certificates")
        self.folder = folder
        self.root = self._make(name, "/CN=test authority", "basicConstraints=critical,CA:TRUE", None, 30)

    def issue(self, name: str, *, alternative: str = "DNS:localhost,IP:127.0.0.1", days: int = 30) -> Pair:
        return self._make(name, f"/CN={name}", f"subjectAltName={alternative}", self.root, days)

    def _make(self, name: str, subject: str, extension: str, issuer: Pair | None, days: int) -> Pair:
        made = Pair(self.folder / f"{name}.pem", self.folder / f"{name}.key")
        command = [
            "openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes",
            "-subj", subject, "-addext", extension, "-days", str(days),
            "-keyout", str(made.key), "-out", str(made.certificate),
        ]  # fmt: skip
        if issuer is not None:
            command += [
                "-CA",
                str(issuer.certificate),
                "-CAkey",
                str(issuer.key),
                "-addext",
                "basicConstraints=CA:FALSE",
            ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return made
