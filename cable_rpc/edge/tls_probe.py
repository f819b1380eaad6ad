"""Why a connection does not come about, found by a handshake of our own: gRPC only says that it failed."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path

from cable_rpc.wire.address import split_address

PROBE_TIMEOUT_S = 2.0
HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\4\0\0\0\0\0"
"""What an HTTP/2 client says first (RFC 9113, section 3.4), with empty SETTINGS."""
TLS_RECORDS = (21, 22)
"""First byte of a TLS alert or handshake record; an HTTP/2 server begins with a SETTINGS frame instead."""


def diagnose(
    address: str,
    *,
    tls: bool,
    server_name: str = "",
    authorities: Path | None = None,
    pair: tuple[Path, Path] | None = None,
) -> str | None:
    """What keeps both ends from ever agreeing.

    Args:
        address: "host:port".
        tls: whether the channel speaks TLS.
        server_name: what the certificate must be made out to; empty = the host.
        authorities: PEM file; None = the system's.
        pair: certificate and key to show.

    Returns:
        A sentence whose subject is the server; None where nothing was found out, or nobody listens.
    """
    if address.startswith("unix:"):
        return None
    host, port = split_address(address)
    try:
        with socket.create_connection((host, int(port)), timeout=PROBE_TIMEOUT_S) as connection:
            if not tls:
                return "speaks TLS; write --target grpcs://HOST:PORT" if speaks_tls(connection, address) else None
            context = ssl.create_default_context(cafile=None if authorities is None else str(authorities))
            context.set_alpn_protocols(["h2"])
            if pair is not None:
                context.load_cert_chain(*pair)
            with context.wrap_socket(connection, server_hostname=server_name or host) as secured:
                # With TLS 1.3 a refusal of the client's certificate comes only now.
                secured.sendall(HTTP2_PREFACE)
                if not secured.recv(1):
                    return refusal(shows_certificate=pair is not None)
    except ssl.SSLCertVerificationError as error:
        return f"shows a certificate that is not trusted: {error.verify_message}; {remedy(error, authorities)}"
    except ssl.SSLError as error:
        return handshake_failure(error, pair is not None)
    except (OSError, ValueError):
        return None
    return None


def speaks_tls(connection: socket.socket, address: str) -> bool:
    """True when a server that does not answer a greeting in plain text agrees to a handshake instead."""
    connection.sendall(HTTP2_PREFACE)
    answer = connection.recv(1)
    if answer and answer[0] not in TLS_RECORDS:
        return False
    # Nothing is sent over it, so nothing needs to be trusted.
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    host, port = split_address(address)
    with socket.create_connection((host, int(port)), timeout=PROBE_TIMEOUT_S) as another:
        try:
            context.wrap_socket(another, server_hostname=host).close()
        except ssl.SSLError:
            return False
    return True


def refusal(*, shows_certificate: bool) -> str:
    """A sentence about a server that hangs up on a client whose handshake was fine; gRPC's give no reason."""
    if shows_certificate:
        return "refused our certificate; have it signed by an authority of the server's --tls-client-ca"
    return "hung up after the handshake: it wants to see a certificate; give --tls-cert and --tls-key"


def handshake_failure(error: ssl.SSLError, shows_certificate: bool) -> str | None:
    """A sentence about a handshake that failed; None where it says nothing."""
    reason = (error.reason or "").lower()
    if "certificate" in reason or "unknown_ca" in reason or "handshake_failure" in reason:
        return f"{refusal(shows_certificate=shows_certificate)} ({reason})"
    if "wrong_version_number" in reason or "record_layer_failure" in reason or "packet_length" in reason:
        return "does not speak TLS; start it with --tls-cert and --tls-key, or write --target grpc://HOST:PORT"
    return None


def remedy(error: ssl.SSLCertVerificationError, authorities: Path | None) -> str:
    """What to do about a certificate that is not trusted (error numbers of OpenSSL's X509_V_ERR)."""
    if error.verify_code in (62, 64):
        return "use the name it is made out to in --target, or give it as --tls-server-name"
    if error.verify_code in (9, 10):
        return "renew it there, or set the clocks right"
    if authorities is None:
        return "give the certificate of its authority as --tls-ca"
    return f"it does not descend from {authorities}"
