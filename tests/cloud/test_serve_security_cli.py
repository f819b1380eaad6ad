"""The flags as a person gives them: real processes, the setup of docs/security.md, errors before anything listens."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from cable_rpc.cli.demo import local_server
from cable_rpc.cli.serve_security import check_exposure
from cable_rpc.errors import ConfigurationError

from .certificates import Authority


def cable_rpc(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "cable_rpc", *arguments], capture_output=True, text=True, check=False)


def test_serve_says_what_is_wrong_with_its_files_before_it_loads_a_model(tmp_path: Path) -> None:
    pair = Authority(tmp_path).issue("server")
    tokens = tmp_path / "tokens"
    tokens.write_text("car-7 not-a-digest\n")
    for flags, said in (
        (("--tls-cert", str(tmp_path / "absent"), "--tls-key", str(pair.key)), "can't be read: No such file"),
        (("--tls-cert", str(pair.certificate)), "--tls-key is missing"),
        (("--tokens", str(tokens)), "line 1: the second word must be the SHA-256"),
    ):
        done = cable_rpc("serve", "--listen", "127.0.0.1:0", "--detector", "onnx:absent.onnx", *flags)
        assert done.returncode == 2
        assert said in done.stderr
        assert "Traceback" not in done.stderr


def test_serve_and_stream_with_mutual_tls_and_a_token(shared_detector: Path, tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    server, car = authority.issue("server"), authority.issue("car-7")
    tokens, token = tmp_path / "tokens", tmp_path / "token"
    token.write_text("a-long-random-word\n")
    tokens.write_text(f"car-7 {hashlib.sha256(b'a-long-random-word').hexdigest()} streams=2\n")
    flags = [
        "--detector", f"onnx:{shared_detector}", "--segmenter", "boxes",
        "--tls-cert", str(server.certificate), "--tls-key", str(server.key),
        "--tls-client-ca", str(authority.root.certificate), "--tokens", str(tokens),
    ]  # fmt: skip
    trust = [
        "--tls-ca", str(authority.root.certificate),
        "--tls-cert", str(car.certificate), "--tls-key", str(car.key),
    ]  # fmt: skip
    with local_server(flags) as target:
        known = cable_rpc("doctor", "--server", f"grpcs://{target}", *trust, "--token-file", str(token))
        assert known.returncode == 0, known.stderr
        assert "TLS" in known.stdout
        assert "onnx:" in known.stdout
        unknown = cable_rpc("doctor", "--server", f"grpcs://{target}", *trust)
        assert unknown.returncode == 2
        assert "does not let us in: a token is needed" in unknown.stderr
        streamed = cable_rpc(
            "stream", "--source", "synthetic:1", "--frames", "3", "--no-evaluate", "--target", f"grpcs://{target}",
            *trust, "--token-file", str(token), "--out", str(tmp_path / "out"),
        )  # fmt: skip
        assert streamed.returncode == 0, streamed.stderr
        assert "a-long-random-word" not in "".join(
            path.read_text(errors="replace") for path in (tmp_path / "out").rglob("*") if path.is_file()
        )


@pytest.mark.parametrize("listen", ["0.0.0.0:50051", "[::]:50051", "gpu-box:50051"])
def test_plain_text_beyond_this_machine_needs_a_flag(listen: str) -> None:
    with pytest.raises(ConfigurationError, match="give --tls-cert and --tls-key, or add --insecure"):
        check_exposure(listen, tls=False, proof=True, insecure=False)
    assert check_exposure(listen, tls=True, proof=True, insecure=False) is None
    assert "add --tokens or --tls-client-ca" in (check_exposure(listen, tls=True, proof=False, insecure=False) or "")
    assert "use TLS" in (check_exposure(listen, tls=False, proof=True, insecure=True) or "")
    assert "everybody who reaches" in (check_exposure(listen, tls=False, proof=False, insecure=True) or "")
    assert check_exposure("127.0.0.1:50051", tls=False, proof=False, insecure=False) is None
