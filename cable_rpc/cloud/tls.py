"""The server's TLS: files checked before it listens, and taken anew when they are renewed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import grpc

from cable_rpc.errors import ConfigurationError
from cable_rpc.wire.pem import KeyPair, load_authorities, load_key_pair

log = logging.getLogger(__name__)

SERVER_FLAGS = ("--tls-cert", "--tls-key")
CLIENT_CA_FLAG = "--tls-client-ca"

Stamps = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Where a server's certificates are."""

    certificate: Path
    """PEM chain, own certificate first."""
    key: Path
    client_ca: Path | None = None
    """With it every client must show a certificate that descends from one of these."""

    @classmethod
    def from_flags(cls, certificate: Path | None, key: Path | None, client_ca: Path | None) -> TlsFiles | None:
        """What was given on the command line; None = no TLS.

        Raises:
            ConfigurationError: one flag needs another.
        """
        if certificate is None and key is None:
            if client_ca is not None:
                raise ConfigurationError(f"{CLIENT_CA_FLAG} needs {' and '.join(SERVER_FLAGS)}: clients show "
                                         "certificates only to a server that shows one")  # fmt: skip
            return None
        if certificate is None or key is None:
            missing = SERVER_FLAGS[0] if certificate is None else SERVER_FLAGS[1]
            raise ConfigurationError(f"{' and '.join(SERVER_FLAGS)} belong together; {missing} is missing")
        return cls(certificate, key, client_ca)

    def load(self) -> KeyPair:
        """Reads and checks all files.

        Raises:
            ConfigurationError: see `load_key_pair` and `load_authorities`.
        """
        self.authorities()
        return load_key_pair(self.certificate, self.key, SERVER_FLAGS)

    def authorities(self) -> bytes | None:
        """PEM of what clients' certificates must descend from; None = they show none."""
        return None if self.client_ca is None else load_authorities(self.client_ca, CLIENT_CA_FLAG)

    def stamps(self) -> Stamps:
        """Changes when a file does."""
        paths = (self.certificate, self.key, *([self.client_ca] if self.client_ca else []))
        return tuple((status.st_mtime_ns, status.st_size) for status in (path.stat() for path in paths))


class RenewingCredentials:
    """Credentials that follow their files: each handshake after a change uses the new ones, open streams go on.

    Files that can't be used are reported, and the last good ones stay in force.
    """

    def __init__(self, files: TlsFiles) -> None:
        self._files = files
        self._stamps = files.stamps()
        pair = files.load()
        if pair.warning:
            log.warning("%s %s: %s", SERVER_FLAGS[0], files.certificate, pair.warning)
        self._initial = self._configuration(pair)

    def credentials(self) -> grpc.ServerCredentials:
        """For one port."""
        # gRPC takes None for "unchanged", which its stubs do not know.
        fetch = cast(Callable[[], grpc.ServerCertificateConfiguration], self.renewed)
        return grpc.dynamic_ssl_server_credentials(
            self._initial, fetch, require_client_authentication=self._files.client_ca is not None
        )

    def renewed(self) -> grpc.ServerCertificateConfiguration | None:
        """The new configuration where a file has changed, None where not; called before each handshake."""
        try:
            stamps = self._files.stamps()
            if stamps == self._stamps:
                return None
            self._stamps = stamps
            configuration = self._configuration(self._files.load())
        except (ConfigurationError, OSError) as error:
            log.error("the renewed certificate can't be used, the old one stays: %s", error)
            return None
        log.info("took the renewed certificate %s", self._files.certificate)
        return configuration

    def _configuration(self, pair: KeyPair) -> grpc.ServerCertificateConfiguration:
        return grpc.ssl_server_certificate_configuration(
            [(pair.key, pair.chain)], root_certificates=self._files.authorities()
        )


def certificate_subject(auth_context: Mapping[str, object]) -> str | None:
    """The common name, or else the first DNS name, of the certificate that the peer has shown; None = it showed none.

    Args:
        auth_context: of a `grpc.ServicerContext`.
    """
    for field in ("x509_common_name", "x509_subject_alternative_name"):
        values = auth_context.get(field)
        if isinstance(values, list | tuple) and values and values[0]:
            return bytes(values[0]).decode("utf-8", "replace")
    return None
