"""The command as a person meets it: real processes, real exit codes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cable_rpc.cli.demo import local_server
from cable_rpc.errors import RemoteError
from cable_rpc.study.run_record import read_frames
from cable_rpc.wire.address import is_loopback


def cable_rpc(*arguments: str, timeout: float = 90) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "cable_rpc", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout,
        env={**os.environ, "COLUMNS": "110", "NO_COLOR": "1"},
    )


@pytest.mark.parametrize("command", ["serve", "stream", "demo"])
def test_help_teaches(command: str) -> None:
    done = cable_rpc(command, "--help")
    assert done.returncode == 0
    assert "--" in done.stdout
    assert len(done.stdout.splitlines()) > 10


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["stream", "--source", "nonsense"],
            "can't open source 'nonsense': known are cadc:..., coco-video:..., kitti:..., ",
        ),
        (["stream", "--source", "video:absent.mp4"], "absent.mp4"),
        (["stream", "--source", "synthetic:1", "--codec", "theora"], "use one of h264"),
        (["stream", "--source", "synthetic:1", "--size", "big"], "WIDTHxHEIGHT"),
        (["stream", "--source", "synthetic:1", "--pace", "fast"], "lockstep or realtime"),
        (["serve", "--detector", "yolo:x"], "no detector back end is called 'yolo'"),
        (["serve", "--detector", "onnx:absent.onnx"], "absent.onnx"),
        (["serve", "--segmenter", "oracle"], "oracle:synthetic:SEED"),
        (["serve", "--listen", "0.0.0.0:0"], "--insecure"),
    ],
    ids=lambda value: " ".join(value[1:]) if isinstance(value, list) else "",
)
def test_misuse_is_one_line_and_exit_code_2(arguments: list[str], said: str) -> None:
    done = cable_rpc(*arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_server_without_its_extra_says_what_to_install() -> None:
    program = "import sys; sys.modules['onnxruntime'] = None; from cable_rpc.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", program, "serve"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.strip() == "cable-rpc: serving needs the cloud extra: pip install 'cable-rpc[cloud]'"


def test_nobody_at_the_target(unused_tcp_port: int, tmp_path: Path) -> None:
    done = cable_rpc(
        "stream", "--source", "synthetic:1", "--frames", "2", "--target", f"127.0.0.1:{unused_tcp_port}",
        "--out", str(tmp_path), "--size", "160x96", "--connect-timeout", "1",
    )  # fmt: skip
    assert done.returncode == 2
    assert "is `cable-rpc serve` running there" in done.stderr


@pytest.mark.parametrize(
    ("address", "loopback"),
    [
        ("127.0.0.1:1", True),
        ("127.9.9.9:1", True),
        ("localhost:1", True),
        ("[::1]:1", True),
        ("0.0.0.0:1", False),
        ("[::]:1", False),
        ("192.0.2.7:1", False),
        ("example.org:1", False),
    ],
)
def test_loopback_addresses(address: str, loopback: bool) -> None:
    assert is_loopback(address) == loopback


def test_server_that_can_not_start_says_why() -> None:
    with (
        pytest.raises(RemoteError, match="no detector back end is called 'nothing'"),
        local_server(["--detector", "nothing"]),
    ):
        pass


def test_taken_port_is_said(shared_detector: Path) -> None:
    detector = f"onnx:{shared_detector}"
    with local_server(["--detector", detector]) as target:
        done = cable_rpc("serve", "--listen", target, "--detector", detector)
        assert done.returncode == 2
        assert f"can't listen on {target}" in done.stderr


def test_real_clip_through_two_processes(shared_clip: Path, shared_detector: Path, tmp_path: Path) -> None:
    with local_server(["--detector", f"onnx:{shared_detector}", "--segmenter", "boxes"]) as target:
        done = cable_rpc(
            "stream", "--source", f"video:{shared_clip}", "--target", target, "--frames", "12", "--codec", "h264",
            "--size", "641x361", "--out", str(tmp_path),
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "bytes saved" in done.stdout
    for name in ("frames.csv", "summary.json", "annotated.mp4", "report.html"):
        assert (tmp_path / name).stat().st_size > 0
    records = read_frames(tmp_path / "frames.csv")
    assert [record.outcome for record in records] == ["answered"] * 12
    assert sum(record.detection_count or 0 for record in records) > 0


def test_demo_runs_the_embedded_models(tmp_path: Path) -> None:
    done = cable_rpc("demo", "--frames", "8", "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "bytes saved" in done.stdout
    assert "recognition at 50%" in done.stdout
    for name in ("frames.csv", "summary.json", "annotated.mp4", "report.html"):
        assert (tmp_path / name).stat().st_size > 0
    assert [record.outcome for record in read_frames(tmp_path / "frames.csv")] == ["answered"] * 8


@contextmanager
def stream_under_way(target: str, clip: Path, out: Path) -> Iterator[subprocess.Popen[str]]:
    """A streaming process that has some frames behind it."""
    command = [sys.executable, "-m", "cable_rpc", "stream", "--source", f"video:{clip}", "--target", target]
    process = subprocess.Popen([*command, "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    part = out / "frames.csv.part"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (part.exists() and part.read_text().count("\n") > 5):
        time.sleep(0.05)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def check_whole_files(out: Path) -> None:
    assert len(read_frames(out / "frames.csv")) >= 5
    assert (out / "summary.json").exists()
    assert not list(out.glob("*.part"))


def test_interrupt_leaves_whole_files(shared_clip: Path, shared_detector: Path, tmp_path: Path) -> None:
    with (
        local_server(["--detector", f"onnx:{shared_detector}"]) as target,
        stream_under_way(target, shared_clip, tmp_path) as process,
    ):
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=30)
        assert process.returncode == 130
        assert "interrupted" in stderr
        assert "Traceback" not in stderr
    check_whole_files(tmp_path)


def test_killed_server_leaves_whole_files(shared_clip: Path, shared_detector: Path, tmp_path: Path) -> None:
    serve = [sys.executable, "-m", "cable_rpc", "serve", "--listen", "127.0.0.1:0"]
    server = subprocess.Popen([*serve, "--detector", f"onnx:{shared_detector}"], stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    target = server.stdout.readline().strip().removeprefix("listening on ")
    with stream_under_way(target, shared_clip, tmp_path) as process:
        server.kill()
        server.communicate()
        _, stderr = process.communicate(timeout=30)
        assert process.returncode == 2
        assert f"the connection to {target} broke" in stderr
        assert "Traceback" not in stderr
    check_whole_files(tmp_path)
