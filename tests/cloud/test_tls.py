"""TLS and mutual TLS over real sockets, with certificates that the openssl command made."""

from __future__ import annotations

import socket
import subprocess
from pathlib import Path

import pytest

from cable_rpc.cloud.authentication import current_identity
from cable_rpc.cloud.tls import TlsFiles
from cable_rpc.edge.channel import ClientSecurity, SecureTarget
from cable_rpc.edge.server_probe import ask_server
from cable_rpc.errors import ConfigurationError, RemoteError
from cable_rpc.wire import pem
from cable_rpc.wire.der import DerError, expiry_of_certificate
from cable_rpc.wire.pem import certificates_in, load_authorities, load_key_pair

from .certificates import Authority, Pair
from .secure_server import client, one_frame, serving

FLAGS = ("--tls-cert", "--tls-key")


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("ca"))


@pytest.fixture(scope="module")
def server_pair(authority: Authority) -> Pair:
    return authority.issue("server")


@pytest.fixture(scope="module")
def client_pair(authority: Authority) -> Pair:
    return authority.issue("car-7", alternative="DNS:car-7")


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("other"))


def files(pair: Pair, client_ca: Path | None = None) -> TlsFiles:
    return TlsFiles(pair.certificate, pair.key, client_ca)


async def test_frames_travel_over_tls(authority: Authority, server_pair: Pair) -> None:
    security = ClientSecurity(authorities=authority.root.certificate)
    async with serving(tls=files(server_pair)) as server:
        for target in (f"grpcs://127.0.0.1:{server.port}", f"localhost:{server.port}"):
            async with client(target, security=security) as session:
                assert len((await one_frame(session)).detections.scores) == 1
        report = await ask_server(SecureTarget(f"grpcs://localhost:{server.port}", security), 5)
        assert report.tls
        assert report.models == ("bright", "boxes")


async def test_mutual_tls_names_the_client(authority: Authority, server_pair: Pair, client_pair: Pair) -> None:
    ca = authority.root.certificate
    async with serving(tls=files(server_pair, ca)) as server:
        target = f"grpcs://127.0.0.1:{server.port}"
        security = ClientSecurity(authorities=ca, certificate=client_pair.certificate, key=client_pair.key)
        async with client(target, security=security) as session:
            await one_frame(session)
            (hosted,) = server._service._sessions
            assert hosted.identity.name == "car-7"
    assert current_identity.get().name == "anybody"


@pytest.mark.parametrize("kind", ["no certificate", "foreign certificate"])
async def test_mutual_tls_refuses_strangers_at_once(
    authority: Authority, stranger: Authority, server_pair: Pair, kind: str
) -> None:
    ca = authority.root.certificate
    pair = stranger.issue("intruder") if kind == "foreign certificate" else None
    security = ClientSecurity(
        authorities=ca, certificate=pair.certificate if pair else None, key=pair.key if pair else None
    )
    said = "refused our certificate" if pair else "wants to see a certificate"
    async with serving(tls=files(server_pair, ca)) as server:
        with pytest.raises(RemoteError, match=said):
            async with client(f"grpcs://127.0.0.1:{server.port}", security=security):
                pass


async def test_client_does_not_trust_another_server(
    authority: Authority, stranger: Authority, server_pair: Pair
) -> None:
    elsewhere = authority.issue("elsewhere", alternative="DNS:elsewhere.example")
    async with serving(tls=files(server_pair)) as server, serving(tls=files(elsewhere)) as other:
        target, other_target = f"grpcs://127.0.0.1:{server.port}", f"grpcs://127.0.0.1:{other.port}"
        cases = [
            (target, ClientSecurity(authorities=stranger.root.certificate), "not trusted.*does not descend from"),
            (target, ClientSecurity(), "not trusted.*give the certificate of its authority as --tls-ca"),
            (other_target, ClientSecurity(authorities=authority.root.certificate), "not trusted.*--tls-server-name"),
        ]
        for where, security, said in cases:
            with pytest.raises(RemoteError, match=said):
                async with client(where, security=security):
                    pass
        named = ClientSecurity(authorities=authority.root.certificate, server_name="elsewhere.example")
        async with client(other_target, security=named) as session:
            await one_frame(session)


async def test_one_end_without_tls_is_told_apart(authority: Authority, server_pair: Pair) -> None:
    async with serving(tls=files(server_pair)) as server:
        with pytest.raises(RemoteError, match="speaks TLS; write --target grpcs://"):
            async with client(f"127.0.0.1:{server.port}"):
                pass
    async with serving() as server:
        with pytest.raises(RemoteError, match="does not speak TLS"):
            async with client(
                f"grpcs://127.0.0.1:{server.port}", security=ClientSecurity(authorities=authority.root.certificate)
            ):
                pass


async def test_renewed_certificate_is_used_without_a_restart(authority: Authority, tmp_path: Path) -> None:
    first, second = authority.issue("first"), authority.issue("second", alternative="DNS:second.example")
    live = Pair(tmp_path / "live.pem", tmp_path / "live.key")

    def install(pair: Pair) -> None:
        live.key.write_bytes(pair.key.read_bytes())
        live.certificate.write_bytes(pair.certificate.read_bytes())

    install(first)
    trusted = ClientSecurity(authorities=authority.root.certificate)
    async with serving(tls=files(live)) as server:
        target = f"grpcs://127.0.0.1:{server.port}"
        async with client(target, security=trusted) as session:
            await one_frame(session, 0)
            install(second)
            renewed = ClientSecurity(authorities=authority.root.certificate, server_name="second.example")
            async with client(target, security=renewed) as other:
                await one_frame(other)
            live.certificate.write_text("damaged")
            async with client(target, security=renewed) as other:
                await one_frame(other)
            assert (await one_frame(session, 1)).rejection is None


def test_unusable_files_are_said_before_listening(authority: Authority, server_pair: Pair, tmp_path: Path) -> None:
    other = authority.issue("other")
    no_pem = tmp_path / "text.pem"
    no_pem.write_text("hello")
    damaged = tmp_path / "damaged.pem"
    damaged.write_text("-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n")
    locked = tmp_path / "locked.key"
    subprocess.run(
        ["openssl", "pkey", "-in", server_pair.key, "-aes256", "-passout", "pass:secret", "-out", locked], check=True
    )
    certificate, key = server_pair.certificate, server_pair.key
    for pair, said in (
        ((tmp_path / "absent", key), "--tls-cert .*absent can't be read: No such file"),
        ((tmp_path, key), "--tls-cert .* can't be read: Is a directory"),
        ((certificate, tmp_path / "absent"), "--tls-key .*absent can't be read"),
        ((no_pem, key), "holds no certificate in PEM form"),
        ((damaged, key), "holds a damaged certificate"),
        ((certificate, certificate), "holds no private key"),
        ((certificate, other.key), "is not the key of --tls-cert"),
        ((certificate, locked), "is encrypted; give a key without a password"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            load_key_pair(*pair, FLAGS)
    with pytest.raises(ConfigurationError, match=r"--tls-client-ca .* holds no certificate"):
        load_authorities(key, "--tls-client-ca")
    with pytest.raises(ConfigurationError, match="--tls-key is missing"):
        TlsFiles.from_flags(certificate, None, None)
    with pytest.raises(ConfigurationError, match="--tls-client-ca needs"):
        TlsFiles.from_flags(None, None, certificate)


def test_end_of_certificates_agrees_with_openssl(
    authority: Authority, server_pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ssl

    shown = subprocess.run(
        ["openssl", "x509", "-in", server_pair.certificate, "-noout", "-enddate"],
        check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    ends_s = ssl.cert_time_to_seconds(shown.strip().removeprefix("notAfter="))
    assert load_key_pair(server_pair.certificate, server_pair.key, FLAGS).expires_s == ends_s
    # 2060 needs the longer form of dates.
    far = authority.issue("far", days=365 * 34)
    shown = subprocess.run(
        ["openssl", "x509", "-in", far.certificate, "-noout", "-enddate"], check=True, capture_output=True, text=True
    ).stdout
    far_s = ssl.cert_time_to_seconds(shown.strip().removeprefix("notAfter="))
    assert load_key_pair(far.certificate, far.key, FLAGS).expires_s == far_s

    monkeypatch.setattr(pem.time, "time", lambda: ends_s - 86_400)
    assert "ends in 1.0 days" in (load_key_pair(server_pair.certificate, server_pair.key, FLAGS).warning or "")
    monkeypatch.setattr(pem.time, "time", lambda: ends_s + 1)
    with pytest.raises(ConfigurationError, match="expired on"):
        load_key_pair(server_pair.certificate, server_pair.key, FLAGS)


def test_damaged_certificates_never_raise_anything_else(server_pair: Pair) -> None:
    (der,) = certificates_in(server_pair.certificate.read_bytes(), server_pair.certificate, "--tls-cert")
    expected = expiry_of_certificate(der)
    for position in range(min(len(der), 160)):
        for value in (0, 0x30, 0x80, 0xFF):
            try:
                expiry_of_certificate(der[:position] + bytes([value]) + der[position + 1 :])
            except DerError:
                continue
        with pytest.raises(DerError):
            expiry_of_certificate(der[:position])
    assert expected > 0


def test_plain_text_target_contradicts_tls_settings(authority: Authority) -> None:
    with pytest.raises(ConfigurationError, match="asks for plain text"):
        SecureTarget("grpc://127.0.0.1:1", ClientSecurity(authorities=authority.root.certificate))
    with pytest.raises(ConfigurationError, match="--tls-cert and --tls-key belong together"):
        SecureTarget("grpcs://127.0.0.1:1", ClientSecurity(certificate=authority.root.certificate))


@pytest.mark.parametrize("text", ["gpu-box", "http://gpu-box:1", "gpu-box:port", ":50051", "gpu-box:99999"])
def test_targets_that_are_none(text: str) -> None:
    with pytest.raises(ConfigurationError, match="target"):
        SecureTarget(text)


async def test_a_server_that_never_answers_is_not_called_untrusted(authority: Authority) -> None:
    """A listening socket that says nothing: neither end can know why."""
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        target = f"grpcs://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(RemoteError, match="no answer from"):
            async with client(
                target, security=ClientSecurity(authorities=authority.root.certificate), connect_timeout_s=0.5
            ):
                pass
