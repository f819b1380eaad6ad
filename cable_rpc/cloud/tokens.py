"""Who may use the server: the file of ``--tokens``, and the search for a token in constant time."""

from __future__ import annotations

import hashlib
import hmac
import logging
import re
from dataclasses import dataclass, fields
from pathlib import Path

from cable_rpc.cloud.limits import Identity, IdentityLimits
from cable_rpc.errors import ConfigurationError

log = logging.getLogger(__name__)

LARGEST_FILE_BYTES = 4 << 20
MOST_TOKEN_BYTES = 4096
"""A longer one is not looked at; headers as a whole are limited to about as much by gRPC."""
NAME = re.compile(r"[A-Za-z0-9._@/-]{1,64}")
DIGEST = re.compile(r"[0-9a-fA-F]{64}")
CERTIFICATE = "certificate"
"""Stands in place of a digest where the name is that of a client's certificate."""


@dataclass(frozen=True, slots=True)
class AccessList:
    """One reading of the file."""

    by_digest: tuple[tuple[bytes, Identity], ...]
    """SHA-256 of a token to who has it."""
    by_subject: dict[str, Identity]
    """Subject of a client's certificate to who it is."""

    @property
    def identities(self) -> dict[str, Identity]:
        """All of them by name."""
        return {**self.by_subject, **{identity.name: identity for _, identity in self.by_digest}}

    def of_token(self, token: str) -> Identity | None:
        """Who has a token; takes as long for a good one as for a bad one."""
        given = token.encode("utf-8", "surrogateescape")
        if not 0 < len(given) <= MOST_TOKEN_BYTES:
            return None
        digest = hashlib.sha256(given).digest()
        found = None
        for expected, identity in self.by_digest:
            if hmac.compare_digest(digest, expected):
                found = identity
        return found

    def of_subject(self, subject: str) -> Identity | None:
        """Who shows a certificate of this subject."""
        return self.by_subject.get(subject)


def parse_access_list(text: str, where: str) -> AccessList:
    """Reads lines ``NAME SHA256_HEX [LIMIT=VALUE ...]`` and ``NAME certificate [LIMIT=VALUE ...]``; # is a comment.

    A name may have several tokens, so that they can be changed without a gap; their limits must agree.

    Args:
        text: the file.
        where: its name, for errors.

    Raises:
        ConfigurationError: with the line.
    """
    by_digest: dict[bytes, Identity] = {}
    by_subject: dict[str, Identity] = {}
    known: dict[str, Identity] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        place = f"{where}, line {number}"
        if len(words) < 2 or not NAME.fullmatch(words[0]):
            raise ConfigurationError(
                f"{place}: write NAME SHA256_OF_TOKEN [LIMIT=VALUE ...], the name of letters, digits and . _ @ / -"
            )
        identity = Identity(words[0], parse_limits(words[2:], place))
        if known.setdefault(identity.name, identity) != identity:
            raise ConfigurationError(f"{place}: {identity.name} has other limits further up; give them alike")
        if words[1] == CERTIFICATE:
            by_subject[identity.name] = identity
        elif not DIGEST.fullmatch(words[1]):
            raise ConfigurationError(
                f"{place}: the second word must be the SHA-256 of the token, 64 hexadecimal digits "
                f"(printf %s TOKEN | sha256sum), or '{CERTIFICATE}'"
            )
        elif by_digest.setdefault(bytes.fromhex(words[1]), identity) != identity:
            raise ConfigurationError(f"{place}: {identity.name} has the token of somebody further up; make another")
    if not known:
        raise ConfigurationError(f"{where} names nobody, so nobody could connect; add a line, or leave --tokens out")
    return AccessList(tuple(by_digest.items()), by_subject)


def parse_limits(words: list[str], place: str) -> IdentityLimits | None:
    """Limits from ``streams=2`` and the like; None where there are none.

    Raises:
        ConfigurationError: an unknown name, or no positive number.
    """
    if not words:
        return None
    names = [field.name for field in fields(IdentityLimits)]
    given: dict[str, float] = {}
    for word in words:
        name, _, value = word.partition("=")
        if name not in names:
            raise ConfigurationError(f"{place}: '{word}' is no limit; use {', '.join(f'{known}=N' for known in names)}")
        try:
            given[name] = float(value)
        except ValueError:
            raise ConfigurationError(f"{place}: '{word}' needs a number, e.g. {name}=30") from None
    try:
        return IdentityLimits(**given)
    except ConfigurationError as error:
        raise ConfigurationError(f"{place}: {error}") from None


class AccessFile:
    """The file as it is now: `refresh` takes changes over.

    Raises:
        ConfigurationError: it can't be read, or a line is wrong.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stamp = self._stamp_now()
        self.list = self._read()

    def refresh(self) -> bool:
        """Reads the file again where it has changed; True when the list is a new one.

        A file that can't be used is reported once, and the last good list stays in force.
        """
        stamp = self._stamp_now()
        if stamp == self._stamp:
            return False
        self._stamp = stamp
        try:
            self.list = self._read()
        except ConfigurationError as error:
            log.error("the changed token file can't be used, the old one stays: %s", error)
            return False
        log.info("read %s again: %d identities", self.path, len(self.list.identities))
        return True

    def _stamp_now(self) -> tuple[int, int, int] | None:
        try:
            status = self.path.stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_size, status.st_ino

    def _read(self) -> AccessList:
        try:
            with self.path.open("rb") as file:
                data = file.read(LARGEST_FILE_BYTES + 1)
            text = data.decode("utf-8")
        except OSError as error:
            raise ConfigurationError(f"--tokens {self.path} can't be read: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise ConfigurationError(f"--tokens {self.path} is no text: {error}") from error
        if len(data) > LARGEST_FILE_BYTES:
            raise ConfigurationError(f"--tokens {self.path} has more than {LARGEST_FILE_BYTES} bytes")
        return parse_access_list(text, f"--tokens {self.path}")
