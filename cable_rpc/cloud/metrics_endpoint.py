"""HTTP for those who look after a server: ``/metrics`` for Prometheus, ``/healthz`` for probes that know no gRPC."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import make_wsgi_app

from cable_rpc.errors import ConfigurationError

REQUEST_TIMEOUT_S = 5.0


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A probe that hangs up is nothing to tell of."""


class _Handler(WSGIRequestHandler):
    timeout = REQUEST_TIMEOUT_S

    def log_message(self, *values: object) -> None:
        """One line for each scrape would drown the rest."""


class MetricsEndpoint:
    """Listens in threads of its own; use as a context manager.

    Args:
        address: HOST:PORT; port 0 picks a free one.
        registry: what is told.
        is_serving: whether ``/healthz`` says so (200), or not (503).

    Raises:
        ConfigurationError: the address can't be used.
    """

    def __init__(self, address: str, registry: CollectorRegistry, is_serving: Callable[[], bool]) -> None:
        host, _, port = address.rpartition(":")
        if not port.isdigit() or int(port) > 65535:
            raise ConfigurationError(f"'{address}' is no HOST:PORT to serve metrics on, e.g. 127.0.0.1:9464")
        self._metrics: Any = make_wsgi_app(registry)
        self._is_serving = is_serving
        try:
            self._server = make_server(
                host.strip("[]") or "127.0.0.1", int(port), self._answer, _Server, handler_class=_Handler
            )
        except OSError as error:
            raise ConfigurationError(f"can't serve metrics on {address}: {error.strerror or error}") from error
        self.port = int(self._server.server_port)
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)

    def __enter__(self) -> MetricsEndpoint:
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _answer(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        path = environ.get("PATH_INFO", "")
        if path == "/metrics":
            return self._metrics(environ, start_response)
        status, body = "404 Not Found", b"try /metrics or /healthz\n"
        if path == "/healthz":
            status, body = ("200 OK", b"serving\n") if self._is_serving() else ("503 Service Unavailable", b"leaving\n")
        start_response(status, [("Content-Type", "text/plain; charset=utf-8")])
        return [body]
