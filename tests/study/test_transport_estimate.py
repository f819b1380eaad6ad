"""The estimate against hand counts and against the kernel's own counters of a quiet network."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.study import transport_counters
from cable_rpc.study.transport_counters import (
    Connection,
    carried_bytes,
    measure_link,
    open_connections,
    plain_address,
)
from cable_rpc.study.transport_estimate import TransportBytes, estimate_exchange, estimate_exchanges

QUIET_NETWORK = Path(__file__).with_name("quiet_network_exchange.py")
TOLERANCE = 0.08


def literal_packets(message: bytes) -> tuple[int, int]:
    """Builds the bytes one by one, as the standards tell: (this direction, the other one)."""
    prefixed = b"\0" + len(message).to_bytes(4, "big") + message
    stream = b""
    while prefixed:
        part, prefixed = prefixed[:16384], prefixed[16384:]
        stream += len(part).to_bytes(3, "big") + b"\0\0" + (1).to_bytes(4, "big") + part
    wire = back = unacknowledged = 0
    while stream:
        segment, stream = stream[:1448], stream[1448:]
        wire += 20 + 20 + 12 + len(segment)
        unacknowledged += 1
        if unacknowledged == 2 or not stream:
            back += 20 + 20 + 12
            unacknowledged = 0
    return wire, back + 9 + 4


@given(st.integers(1, 60_000), st.integers(0, 20_000))
def test_same_as_packets_cut_one_by_one(uplink: int, downlink: int) -> None:
    up, up_back = literal_packets(bytes(uplink))
    down, down_back = literal_packets(bytes(downlink)) if downlink else (0, 0)
    assert estimate_exchange(uplink, downlink) == TransportBytes(up + down_back, down + up_back)


def test_one_byte_by_hand() -> None:
    assert estimate_exchange(1, 0) == TransportBytes(1 + 5 + 9 + 52, 52 + 13)
    assert estimate_exchanges([(1, 0), (1, 0)]) == TransportBytes(134, 130)
    assert estimate_exchanges([]) == TransportBytes(0, 0)


@pytest.mark.parametrize("uplink", [1_000, 5_000, 20_000])
def test_estimate_holds_against_the_interface_of_a_quiet_network(uplink: int) -> None:
    """A network of its own with the MTU of Ethernet; TCP_INFO must agree with the interface far more closely."""
    counted = in_a_quiet_network(uplink, uplink // 10)
    estimate = estimate_exchange(uplink, uplink // 10)
    frames = counted["frames"]
    assert (estimate.uplink + estimate.downlink) * frames == pytest.approx(counted["interface"], rel=TOLERANCE)
    assert estimate.uplink * frames == pytest.approx(counted["tcp_uplink"], rel=TOLERANCE)
    assert counted["tcp_uplink"] + counted["tcp_downlink"] == pytest.approx(counted["interface"], rel=0.02)


def in_a_quiet_network(uplink: int, downlink: int) -> dict[str, int]:
    unshare = shutil.which("unshare")
    command = [str(unshare), "--net", "--map-root-user", sys.executable, str(QUIET_NETWORK), str(uplink), str(downlink)]
    if unshare is None or subprocess.run([*command[:3], "true"], check=False, capture_output=True).returncode:
        pytest.skip("needs Linux with unprivileged network namespaces (unshare --net)")
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if done.returncode == 3:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's struct tcp_info")
def test_counters_of_our_own_connection_and_of_no_other() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        target = f"127.0.0.1:{server.getsockname()[1]}"
        assert open_connections(target) == []
        with socket.create_connection(server.getsockname()) as client, server.accept()[0] as answerer:
            client.sendall(bytes(10_000))
            received = 0
            while received < 10_000:
                received += len(answerer.recv(65536))
            answerer.sendall(bytes(500))
            assert len(client.recv(65536)) == 500
            (connection,) = open_connections(target)
            assert 10_000 < connection.carried.uplink < 11_000
            assert 500 < connection.carried.downlink < 1_500
            client.sendall(b"still open")
        assert measure_link(target) is None  # loopback is no link


def test_headers_by_ip_version_and_time_stamps() -> None:
    info = bytearray(216)
    info[128:136] = (700).to_bytes(8, sys.byteorder)
    info[136:140] = (3).to_bytes(4, sys.byteorder)
    info[140:144] = (2).to_bytes(4, sys.byteorder)
    info[200:208] = (900).to_bytes(8, sys.byteorder)
    assert carried_bytes(bytes(info), ip_version=4) == TransportBytes(900 + 3 * 40, 700 + 2 * 40)
    info[5] = 1
    assert carried_bytes(bytes(info), ip_version=4) == TransportBytes(900 + 3 * 52, 700 + 2 * 52)
    assert carried_bytes(bytes(info), ip_version=6) == TransportBytes(900 + 3 * 72, 700 + 2 * 72)


@pytest.mark.parametrize(
    ("local", "peer", "link"),
    [
        ("192.0.2.1", "192.0.2.7", True),
        ("192.0.2.1", "192.0.2.1", False),
        ("127.0.0.1", "127.0.0.2", False),
        ("::1", "::1", False),
        ("2001:db8::1", "2001:db8::2", True),
    ],
)
def test_one_machine_is_no_link(local: str, peer: str, link: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    carried = TransportBytes(100, 10)
    both = [Connection(local, peer, carried), Connection(local, peer, carried)]
    monkeypatch.setattr(transport_counters, "open_connections", lambda target: both)
    assert measure_link("any:1") == (TransportBytes(200, 20) if link else None)


@pytest.mark.parametrize("target", ["", "unix:/run/x.sock", "dns:///host", "127.0.0.1:1", "no.such.host.invalid:5"])
def test_targets_without_a_connection_are_not_measured(target: str) -> None:
    assert measure_link(target) is None


def test_addresses_compare_equal_however_written() -> None:
    assert plain_address("::ffff:10.0.0.1") == "10.0.0.1"
    assert plain_address("fe80::1%eth0") == "fe80::1"
